"""The studies of a series of tasks and of the first success, with small budgets."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.deep.tasks import optimal_steps
from experiments.first_success import __main__ as first_success
from experiments.first_success.conditions import run as run_until_success
from experiments.series.__main__ import Study, main
from experiments.series.conditions import run
from experiments.series.tasks import Chain
from sb3_options.envs import GridWorld


def test_the_goal_moves_on_and_the_observations_stay_the_same() -> None:
    chain = Chain(4)
    first, last = (chain.task(rooms) for rooms in (2, 4))
    assert isinstance(first, GridWorld)
    assert isinstance(last, GridWorld)
    assert first.observation_space == last.observation_space
    assert sorted(first.doorways) == sorted(last.doorways) == [(5, 3), (11, 1), (17, 3)]
    assert (first.goal, last.goal) == ((10, 2), (22, 2))
    assert chain.series() == [2, 3, 4]
    assert optimal_steps(first) < optimal_steps(last)


@pytest.mark.slow
def test_options_of_one_task_are_there_in_the_next() -> None:
    result = run("options", Chain(3, n_timesteps=20_000), 0)
    first, second = result["tasks"]
    assert result["solved"]
    assert (first["rooms"], second["rooms"]) == (2, 3)
    doorway = [np.abs(np.array(subgoal) - (5, 3)).max() <= 1 for subgoal in first["found"]]
    assert any(doorway)
    assert second["kept"] == first["kept"] + len(second["found"]) - second["freed"]
    assert result["steps"] == first["steps"] + second["steps"]


def test_a_series_ends_where_a_task_is_not_solved(tmp_path: Path) -> None:
    chain = Chain(3, max_steps=60, n_timesteps=600)
    main(Study(out=tmp_path, runs=2, first_seed=0, jobs=1, chain=chain, arms=("network", "alone")))
    written = json.loads((tmp_path / "results.json").read_text())
    for arm, rooms in (("network", [2]), ("alone", [3])):
        assert written["summary"][arm] == {"n_runs": 2, "solved": 0, "steps": None, "last_steps": None}
        assert [[task["rooms"] for task in each["tasks"]] for each in written["runs"][arm]] == [rooms, rooms]
    assert (tmp_path / "series.png").stat().st_size > 5_000


def test_training_ends_at_the_first_success() -> None:
    result = run_until_success("TwoRooms", "discovery, count bonus", 1)
    assert 0 < result["first_success"] < 20_000


def test_first_successes_are_summarised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.first_success.conditions.N_TIMESTEPS", 300)
    study = first_success.Study(out=tmp_path, runs=2, first_seed=0, jobs=1, tasks=("KeyDoor",), arms=("stock",))
    first_success.main(study)
    row = json.loads((tmp_path / "results.json").read_text())["summary"]["KeyDoor: stock"]
    assert (row["n_runs"], row["n_reached"], row["mean"]) == (2, 0, 20_000)
