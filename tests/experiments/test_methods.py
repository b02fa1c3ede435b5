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
from experiments.methods.entrants import NONE
from experiments.methods.summary import summarise
from experiments.methods.tasks import TASKS, step_limit, task_for
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


class TestSummary:
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

    def test_a_success_after_the_criterion_counts_as_the_criterion(self) -> None:
        runs = [result(1000), result(1000), result(None)]
        for run, successes in zip(runs, ([100, 1200], [400], []), strict=True):
            run["same"]["successes"] = run["moved"]["successes"] = successes
        same = summarise({NONE: runs}, 5000)[NONE]["same"]
        assert same["first_success"]["mean"] == pytest.approx(np.mean([100, 400, 5000]))
        assert same["second_success"]["mean"] == pytest.approx(np.mean([1000, 1000, 5000]))


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
    """With a score by hand: the fewer graphs it waits for, the better."""
    monkeypatch.setattr(tune, "score", lambda tuning, settings, folder: float(settings["min_seen"]))
    file = tmp_path / "tuned.json"
    file.write_text('{"l-cut": {"settings": {}}}')
    for trials in (3, 6):
        tune.main(tune.Tuning(out=tmp_path, method="betweenness", trials=trials, chosen=file, jobs=1))
    tuned = json.loads(file.read_text())
    assert set(tuned) == {"betweenness", "l-cut"}
    assert tuned["betweenness"]["score_of_defaults"] == 10.0
    assert tuned["betweenness"]["score"] == tuned["betweenness"]["settings"]["min_seen"] <= 10
    with pytest.raises(SystemExit, match=r"^--method: 'none' has nothing to tune, choose from diverse-density,"):
        tune.Tuning(out=tmp_path, method="none")


def refuse(*args: object) -> None:
    raise AssertionError(args)
