import json
from functools import partial
from pathlib import Path

import pytest

from experiments.empty_slots import conditions
from experiments.empty_slots.__main__ import Study, main
from experiments.empty_slots.conditions import ARMS, N_TIMESTEPS, TASKS


def test_study_writes_results_and_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PPO", "MaskablePPO"):
        monkeypatch.setattr(conditions, name, partial(getattr(conditions, name), n_steps=64, n_epochs=1))
    for name in TASKS:
        monkeypatch.setitem(N_TIMESTEPS, name, 128)
    main(Study(out=tmp_path, runs=2, first_seed=0, jobs=1, algorithms=tuple(TASKS)))
    written = json.loads((tmp_path / "results.json").read_text())
    assert set(written["summary"]) == {f"{algorithm}, {arm}" for algorithm in TASKS for arm in ARMS}
    for algorithm in TASKS:
        assert written["summary"][f"{algorithm}, stock"]["n_runs"] == 2
        assert set(written["summary"][f"{algorithm}, callback"]) == {"n_runs", "final_return", "difference", "p_same"}
    assert (tmp_path / "empty_slots.png").stat().st_size > 5_000
