import json
from pathlib import Path

import pytest

from experiments.learned_spaces.__main__ import Study, main
from experiments.learned_spaces.conditions import ARMS, NAMES, TASKS


@pytest.fixture(autouse=True)
def _learned_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_options.embedding.learner.FIRST_TRAJECTORIES", 2)


def test_study_writes_results_and_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.learned_spaces.conditions.N_EPISODES", 2)
    main(Study(out=tmp_path, runs=1, first_seed=0, jobs=1))
    written = json.loads((tmp_path / "results.json").read_text())
    names = {f"{task}: {NAMES.get(arm, arm)}" for task in TASKS for arm in ARMS}
    assert set(written["summary"]) == set(written["runs"]) == names
    assert written["embedding"]["updates"] > 0
    assert written["summary"]["TwoRooms: coordinates"]["rank_correlation"] is None
    assert (tmp_path / "learned_spaces.png").stat().st_size > 5_000
