import json
from functools import partial
from pathlib import Path

import pytest

from experiments.empty_slots import conditions
from experiments.empty_slots.__main__ import Study, main
from experiments.empty_slots.conditions import ARMS, N_TIMESTEPS, TASKS


@pytest.mark.parametrize("algorithm", TASKS)
def test_study_writes_results_and_picture(algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(N_TIMESTEPS, algorithm, 300)
    for name in ("PPO", "MaskablePPO"):
        monkeypatch.setattr(conditions, name, partial(getattr(conditions, name), n_steps=64))
    main(Study(out=tmp_path, runs=2, first_seed=0, jobs=1, algorithms=(algorithm,)))
    written = json.loads((tmp_path / "results.json").read_text())
    assert set(written["summary"]) == {f"{algorithm}, {arm}" for arm in ARMS}
    assert written["summary"][f"{algorithm}, stock"]["n_runs"] == 2
    assert set(written["summary"][f"{algorithm}, callback"]) == {"n_runs", "final_return", "difference", "p_same"}
    assert (tmp_path / "empty_slots.png").stat().st_size > 5_000
