"""The race: its tasks, what is measured, tiny runs that go on where they were, tables and tuning."""

import json
import math
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from experiments.common.gridworlds import rooms_of, world_of
from experiments.methods import conditions, tune
from experiments.methods.__main__ import Study, main, table
from experiments.methods.conditions import LENGTHS, Entry, length_of, run
from experiments.methods.entrants import (
    EM_DD,
    ENTRANTS,
    FILTERED,
    HAND_MADE,
    NONE,
    TUNABLE,
    all_settings_of,
    chosen_settings,
    discovery_of,
)
from experiments.methods.filtered import FilteredDiscovery
from experiments.methods.report import Report, all_parts, parts_of
from experiments.methods.report import means as means_table
from experiments.methods.spaces import SPACES, defaults_of
from experiments.methods.summary import over_tasks, summarise
from experiments.methods.tasks import (
    TASKS,
    at_bottleneck,
    best_taxi_steps,
    moved_goal,
    places,
    step_limit,
    task_for,
)
from experiments.random_walks.maps import random_map
from sb3_options.discovery.methods import GivenPlaces
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.envs import GridWorld
from sb3_options.experience.trajectories import Trajectory

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

    def test_the_goal_moves_anywhere_in_its_room(self) -> None:
        """A fixed corner was the very subgoal of options that lead to corners."""
        for name in ("TwoRooms", "random maps"):
            world = world_of("sb3_options/TwoRooms-v0", **task_for(name, 0).same)
            (x, y), (room,) = world.goal, [room for room in rooms_of(world) if world.goal in room]
            cells = {moved_goal(world, seed) for seed in range(600)}
            assert cells == {(i, j) for i, j in room if abs(i - x) + abs(j - y) >= 2}
            assert moved_goal(world, 5) == moved_goal(world, 5)

    @pytest.mark.parametrize("name", [task for task in TASKS if task != "Pioneer"])
    def test_places_by_hand_are_bottlenecks(self, name: str) -> None:
        task = task_for(name, 5)
        assert places(task)
        assert all(at_bottleneck(task, point) for point in places(task))

    def test_random_maps_have_two_to_six_rooms(self) -> None:
        counts = set()
        for seed in range(40):
            world = GridWorld(task_for("random maps", seed).same["map"])
            counts.add(len(rooms_of(world)))
        assert counts == {2, 3, 4, 5, 6}

    def test_the_maps_of_the_other_study_are_as_they_were(self) -> None:
        """Random maps of `experiments.random_walks` are drawn by their first arguments."""
        assert random_map(0, shapes=((1, 2), (1, 3), (2, 2)), sides=(4, 9)) == random_map(0)

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

    def test_the_robot_has_a_place_by_hand_and_a_shorter_training(self) -> None:
        task = task_for("Pioneer", 0)
        assert places(task) == [(0.0, math.radians(45))]
        assert at_bottleneck(task, places(task)[0]) is None
        assert length_of("Pioneer", "macroq") < length_of("TwoRooms", "macroq") == LENGTHS["macroq"]


class TestEntrants:
    def test_each_discovers_in_its_way(self) -> None:
        task = task_for("TwoRooms", 0)
        for entrant in ENTRANTS:
            settings, method = discovery_of(entrant, {}, task, 0)
            alone = settings.method == entrant or entrant in (EM_DD, NONE)
            assert (method is None) == alone
        assert isinstance(discovery_of(HAND_MADE, {}, task, 0)[1], GivenPlaces)

    @pytest.mark.parametrize("method", SPACES)
    def test_what_is_tuned_includes_the_defaults(self, method: str) -> None:
        defaults = defaults_of(method)
        assert set(defaults) == set(SPACES[method])
        for name, value in defaults.items():
            space = SPACES[method][name]
            assert space._contains(space.to_internal_repr(value)), name
        discovery_of(method, defaults, task_for("TwoRooms", 0), 0)  # takes them

    def test_all_that_have_settings_are_tuned(self) -> None:
        assert set(SPACES) == TUNABLE

    def test_settings_that_are_not_there_yet(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("experiments.methods.entrants.TUNED", tmp_path / "tuned.json")
        assert chosen_settings(("l-cut", NONE), "defaults") == {"l-cut": {}, NONE: {}}
        with pytest.raises(SystemExit, match=r"^--settings tuned: l-cut not tuned yet, see python -m experiments.meth"):
            chosen_settings(("l-cut", NONE), "tuned")
        (tmp_path / "tuned.json").write_text('{"l-cut": {"settings": {"max_cut": 0.1}}}')
        assert chosen_settings(("l-cut", NONE), "tuned") == {"l-cut": {"max_cut": 0.1}, NONE: {}}

    def test_described_with_the_defaults(self) -> None:
        """Results that were made with other defaults are no results of today's."""
        assert all_settings_of("diverse-density", {"decay": 0.5})["decay"] == 0.5
        assert all_settings_of("diverse-density", {})["min_positive"] == DiscoverySettings().min_positive
        assert all_settings_of("em-dd", {})["method"] == "em-dd"
        assert all_settings_of("random", {}) == {"min_successes": 4}
        assert all_settings_of("every-visit", {"decay": 0.5}) | {"radius": 0} == {
            "decay": 0.5, "threshold": 0.6, "min_successes": 4, "radius": 0
        }  # fmt: skip
        assert all_settings_of(NONE, {}) == all_settings_of(HAND_MADE, {}) == {}


class TestSummary:
    def test_where_all_runs_agree_the_interval_is_that_of_so_many_runs(self) -> None:
        runs = {"l-cut": [result(1000, near=(True, True), seed=seed) for seed in range(10)]}
        near = summarise(runs, 6000)["l-cut"]["near"]
        assert near["mean"] == near["high"] == 1.0
        assert near["low"] == pytest.approx(0.722, abs=1e-3)

    def test_ratios_to_random_places(self) -> None:
        runs = {"l-cut": [result(1000, 500)], "random": [result(2000, 2000)]}
        summary = summarise(runs, 6000)
        assert summary["l-cut"]["same"]["of_random"]["mean"] == 0.5
        assert summary["l-cut"]["moved"]["of_random"]["mean"] == 0.25
        assert summary["random"]["same"]["of_random"] is None

    def test_all_tasks_in_one_number(self) -> None:
        runs = {
            "A, macroq, none": [result(4000, 1000)],
            "A, macroq, l-cut": [result(1000, 1000)],
            "A, macroq, random": [result(1000)],
            "A, dqn, l-cut": [result(1000)],
            "B, macroq, l-cut": [result(None, 500)],
            "B, macroq, none": [result(6000, 1000)],
        }
        means = over_tasks(runs, {"A, macroq": 6000, "B, macroq": 6000, "A, dqn": 6000})
        assert list(means) == ["macroq"]  # there are no primitives with the other
        assert list(means["macroq"]) == ["l-cut", "none"]  # the other was not everywhere; fewest steps first
        cut = means["macroq"]["l-cut"]
        assert cut["n_runs"] == 2
        assert cut["same"]["of_primitives"]["mean"] == pytest.approx((1 / 4 * 1) ** 0.5)
        assert cut["moved"]["of_primitives"]["mean"] == pytest.approx((1 * 1 / 2) ** 0.5)
        assert (cut["same"]["never"], cut["moved"]["never"]) == (1, 0)
        assert cut["same"]["of_random"] is None

        cut["same"]["of_primitives"] = {"mean": 0.5, "low": 0.5, "high": 0.5}  # no interval, and not primitives
        lines = means_table(means).splitlines()
        assert lines[0] == "| | MacroQ, same task | MacroQ, goal moved |"
        assert lines[2].startswith("| l-cut | ≥0.50 (0.50 to 0.50) | 0.71 (")
        assert lines[3] == "| none | 1 | 1 |"

    def test_the_interval_of_all_tasks_is_narrower_than_that_of_each(self) -> None:
        steps, rng = np.random.default_rng(0).integers(1000, 5000, (2, 2, 20)), np.random.default_rng(1)
        runs = {
            f"{task}, macroq, {entrant}": [result(int(n), int(n), seed=i) for i, n in enumerate(rng.permutation(of))]
            for task, both in zip("AB", steps, strict=True)
            for entrant, of in zip(("l-cut", NONE), both, strict=True)
        }
        together = over_tasks(runs, {"A, macroq": 6000, "B, macroq": 6000})["macroq"]["l-cut"]["same"]["of_primitives"]
        alone = over_tasks(runs, {"A, macroq": 6000})["macroq"]["l-cut"]["same"]["of_primitives"]
        assert together["low"] < together["mean"] < together["high"]
        assert together["high"] - together["low"] < alone["high"] - alone["low"]

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

    def test_the_tables(self) -> None:
        runs = {"l-cut": [result(1000, None, near=(True,))], NONE: [result(2000)]}
        summary = summarise(runs, 6000)
        rows = table("TwoRooms", "macroq", summary)
        assert [len(list(column.cells)) for column in rows.columns] == [2] * 9
        parts = parts_of({"command": "race", "summary": {"TwoRooms": {"macroq": summary}}})
        assert parts["command"] == "`race`"
        lines = parts["race"].splitlines()
        assert lines[0] == "**TwoRooms, macroq**"
        assert lines[4].startswith(
            "| l-cut | 1.0 | 1.00 (0.21 to 1.00) | 0.80 (0.80 to 0.80) | 0.50 (0.50 to 0.50) | 6.00"
        )
        assert lines[4].endswith(", 1 never | 1.00 |")
        assert re.match(r"\| none \| [\d.]+ \| – \| 0.80", lines[5])
        assert "2,000" in lines[5]
        assert parts["overview"].splitlines() == ["| | TwoRooms |", "|---|---|", "| l-cut | 0.50, ≥6.00 |"]


def test_a_run_of_a_control_carries_its_options_over() -> None:
    found = run(Entry("FourRooms", "macroq", "random", {}, 2 * SHORT), 0)
    assert found["found"]
    assert found["moved"]["decided"] > 0  # runs of options that were found in the same task
    assert found["same"]["seconds"] > found["same"]["discovery"] > 0


@pytest.mark.parametrize(("min_passing", "several"), [(0.7, False), (0.0, True)])
def test_a_control_draws_from_the_states_that_diverse_density_searches(min_passing: float, several: bool) -> None:
    """All ways lead through (4, 0), and go apart before and after."""
    settings = DiscoverySettings(start_radius=1, goal_radius=1, min_cut=0.0, min_passing=min_passing)
    drawn = set()
    for seed in range(12):
        discovery = FilteredDiscovery(settings, seed=seed)
        for way in range(6):
            x = np.arange(9.0)
            states = np.stack([x, np.where(x == 4, 0.0, 2.0 * way)], axis=1)
            how = (np.zeros(8, dtype=np.int64), np.zeros(8), True, False, True)
            discovery.add(Trajectory(states, np.arange(9), *how), states, success=True)
            discovery.search()
        drawn.add(tuple(discovery.found[0].centre.tolist()))
    assert len(drawn) > 4 if several else drawn == {(4.0, 0.0)}


def test_the_race_takes_it_where_it_is_named() -> None:
    entry = Entry("FourRooms", "macroq", FILTERED, {}, 4 * SHORT)
    assert FILTERED not in ENTRANTS
    assert all_settings_of(FILTERED, {})["method"] == FILTERED
    found = run(entry, 0)["found"]
    assert found
    assert all(each["near"] for each in found)  # the filters leave bottlenecks alone


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


def test_the_tables_of_the_page() -> None:
    page = Path("docs/studies/methods.md").read_text()
    assert all(part in page for part in all_parts(Report()).values())


def refuse(*args: object) -> None:
    raise AssertionError("it was there already")


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"methods": ("lcut",)}, r"^--methods: there is no 'lcut', choose from diverse-density, first-visits,"),
        ({"tasks": ("Rooms",)}, r"^--tasks: there is no 'Rooms', choose from TwoRooms,"),
        ({"learners": ("sac",)}, r"^--learners: there is no 'sac', choose from macroq, dqn, ppo\.$"),
    ],
)
def test_what_there_is_not(kwargs: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=message):
        Study(out=tmp_path, **kwargs)


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


def test_tuning_that_was_killed_goes_on_with_the_trial_it_was_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where that were the defaults."""
    tried: list[tuple[str, float]] = []
    killed_at = {0, 2}

    def score(tuning: object, settings: dict[str, Any], folder: Path) -> float:
        tried.append((folder.name, settings["min_trajectories"]))
        if len(tried) - 1 in killed_at:
            raise KeyboardInterrupt
        return float(settings["min_trajectories"])

    monkeypatch.setattr(tune, "score", score)
    told = tune.Tuning(out=tmp_path, method="covering", trials=3, chosen=tmp_path / "tuned.json", jobs=1)
    for _ in killed_at:
        with pytest.raises(KeyboardInterrupt):
            tune.main(told)
    tune.main(told)
    assert tried[0] == tried[1] == ("0", 10)
    assert tried[2] == tried[3]
    assert len(tried) == 5
    assert json.loads((tmp_path / "tuned.json").read_text())["covering"]["score_of_defaults"] == 10.0


def test_a_trial_is_scored_by_its_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = tune.Tuning(out=tmp_path, method="covering", seeds=1, tasks=("FourRooms",), n_timesteps=SHORT, jobs=1)
    scored = tune.score(told, {"n_pairs": 1, "min_trajectories": 3}, tmp_path / "0")
    assert math.log(1000) <= scored <= math.log(SHORT)
    monkeypatch.setattr(conditions, "make_learner", refuse)
    assert tune.score(told, {"n_pairs": 1, "min_trajectories": 3}, tmp_path / "0") == scored
