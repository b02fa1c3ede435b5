import json
from pathlib import Path
from typing import Literal

import pytest

from experiments.random_walks.__main__ import COMPARED, Study, main
from experiments.random_walks.conditions import TASKS, is_bottleneck, world_for


def test_what_counts_as_a_bottleneck() -> None:
    world = world_for("KeyDoor", 0)
    assert [is_bottleneck(world, point) for point in ([6, 3, 5], [5, 3, 5], [0, 7, 5], [0, 6, 0])] == [True] * 4
    assert not is_bottleneck(world, [1, 6, 0])
    assert not is_bottleneck(world, [3, 3, 0])


@pytest.mark.parametrize(("compare", "noise"), [("methods", 0.0), ("waiting", 0.3)])
def test_study_writes_results_and_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compare: Literal["methods", "waiting"], noise: float
) -> None:
    monkeypatch.setattr("experiments.random_walks.conditions.N_EPISODES", 2)
    main(Study(out=tmp_path, runs=1, first_seed=0, jobs=1, compare=compare, noise=noise))
    written = json.loads((tmp_path / "results.json").read_text())
    assert written["command"].endswith(f"--compare {compare}" + (" --noise 0.3" if noise else ""))
    assert set(written["summary"]) == {f"{task}: {arm}" for task in TASKS for arm in COMPARED[compare]}
    assert (tmp_path / "random_walks.png").stat().st_size > 10_000
