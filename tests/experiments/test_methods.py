"""The race: its tasks, what is measured, tiny runs that go on where they were, tables and tuning."""

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from experiments.common.gridworlds import rooms_of
from experiments.methods import conditions, tune
from experiments.methods.__main__ import Study, main
from experiments.methods.entrants import (
    NONE,
)
from experiments.methods.summary import summarise
from experiments.methods.tasks import (
    TASKS,
    at_bottleneck,
    best_taxi_steps,
    step_limit,
    task_for,
)
from sb3_options.envs import GridWorld

SHORT = 2000
"""Primitive steps: two evaluations, and too few successes for most methods."""


def result(same: int | None, moved: int | None = 1000, *, near: tuple[bool, ...] = (), seed: int = 0) -> dict[str, Any]:
    """A run by hand."""
    trained = {"trained": 5000, "decided": 10, "reached": 8, "seconds": 4.0, "discovery": 1.0}
    found = [{"episode": 1, "timestep": 9, "where": "1, 1", "near": each} for each in near]
    return {"seed": seed, "same": {"steps": same, **trained}, "moved": {"steps": moved, **trained}, "found": found}


class TestTasks:
    @pytest.mark.parametrize("name", [task for task in TASKS if task != "Pioneer"])
    def test_the_goal_moves_and_observations_stay(self, name: str) -> None:
        task = task_for(name, 3)
        same, moved = (gym.make(task.env, **kwargs) for kwargs in (task.same, task.moved))
        assert same.observation_space == moved.observation_space
        if isinstance(same.unwrapped, GridWorld):
            assert isinstance(moved.unwrapped, GridWorld)
            assert same.unwrapped.goal != moved.unwrapped.goal
            room = next(room for room in rooms_of(same.unwrapped) if same.unwrapped.goal in room)
            assert moved.unwrapped.goal in room
        assert step_limit(task, task.same) > 20

    def test_taxi(self) -> None:
        env = gym.make("experiments/Taxi-v0", destination=2)
        starts = {env.reset(seed=seed)[0] for seed in range(200)}
        assert max(starts) < 125
        assert {start % 5 for start in starts} == {0, 1, 3}  # waiting at another stop than the destination
        assert 10 < best_taxi_steps(2) < 20
        task = task_for("Taxi", 0)
        aboard_elsewhere, waiting_elsewhere = np.eye(125)[[(2 * 5 + 2) * 5 + 4, (2 * 5 + 2) * 5 + 1]]
        assert not at_bottleneck(task, aboard_elsewhere)
        assert not at_bottleneck(task, waiting_elsewhere)
        assert at_bottleneck(task, np.eye(125)[(0 * 5 + 4) * 5 + 1])  # at stop 1, where the passenger waits
        assert not at_bottleneck(task, np.eye(125)[(0 * 5 + 0) * 5 + 4])  # at the destination, the goal


class TestSummary:
    def test_ratios_to_random_places(self) -> None:
        runs = {"l-cut": [result(1000, 500)], "random": [result(2000, 2000)]}
        summary = summarise(runs, 6000)
        assert summary["l-cut"]["same"]["of_random"]["mean"] == 0.5
        assert summary["l-cut"]["moved"]["of_random"]["mean"] == 0.25
        assert summary["random"]["same"]["of_random"] is None

    def test_what_is_measured(self) -> None:
        runs = {
            "l-cut": [result(1000, near=(True, False)), result(None, near=(True, True), seed=1)],
            NONE: [result(2000, 4000), result(4000, None, seed=1)],
        }
        summary = summarise(runs, 6000)
        cut = summary["l-cut"]
        assert cut["found"]["mean"] == 2.0
        assert cut["near"]["mean"] == 0.75
        assert cut["reached"]["mean"] == 0.8
        assert cut["discovery_share"]["mean"] == 0.25
        assert cut["same"]["never"] == 1
        assert cut["same"]["of_primitives"]["mean"] == pytest.approx((1000 + 6000) / (2000 + 4000))
        assert cut["moved"]["of_primitives"]["mean"] == pytest.approx(2000 / (4000 + 6000))
        assert summary[NONE]["near"] is None
        assert summary[NONE]["same"]["of_primitives"] is None


def test_the_race_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: dict[str, Any] = {"out": tmp_path, "runs": 1, "first_seed": 0, "jobs": 1, "n_timesteps": SHORT}
    small: dict[str, Any] = {"tasks": ("FourRooms",), "learners": ("macroq",)}
    main(Study(**told, **small, methods=(NONE,)))
    monkeypatch.setattr(conditions, "make_learner", refuse)  # whatever is trained again fails
    main(Study(**told, **small, methods=(NONE,)))
    monkeypatch.undo()
    main(Study(**told, **small, methods=("random", NONE)))
    written = json.loads((tmp_path / "results.json").read_text())
    assert written["command"] == (
        "python -m experiments.methods --runs 1 --first-seed 0 --settings defaults --methods random none "
        "--tasks FourRooms --learners macroq --n-timesteps 2000"
    )
    assert set(written["summary"]["FourRooms"]["macroq"]) == {"random", NONE}
    assert set(written["runs"]) == {"FourRooms, macroq, random", "FourRooms, macroq, none"}
    assert (tmp_path / "race.png").stat().st_size > 5_000


def test_tuning_goes_on_and_keeps_the_best(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a score by hand: the fewer trajectories it waits for, the better."""
    monkeypatch.setattr(tune, "score", lambda tuning, settings, folder: float(settings["min_trajectories"]))
    file = tmp_path / "tuned.json"
    file.write_text('{"l-cut": {"settings": {}}}')
    for trials in (3, 6):
        tune.main(tune.Tuning(out=tmp_path, method="covering", trials=trials, chosen=file, jobs=1))
    tuned = json.loads(file.read_text())
    assert set(tuned) == {"covering", "l-cut"}
    assert tuned["covering"]["score_of_defaults"] == 10.0
    assert tuned["covering"]["score"] == tuned["covering"]["settings"]["min_trajectories"] <= 10
    with pytest.raises(SystemExit, match=r"^--method: 'none' has nothing to tune, choose from diverse-density,"):
        tune.Tuning(out=tmp_path, method="none")


def refuse(*args: object) -> None:
    raise AssertionError(args)
