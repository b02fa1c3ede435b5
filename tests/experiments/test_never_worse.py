import json
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import pytest

from experiments.never_worse import __main__ as never_worse
from experiments.never_worse.tasks import CLIFF, CLIFF_STEPS, POINT_MAZE, TASKS


def test_discovery_on_and_off_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    easy, hard = (replace(TASKS["FrozenLake"], frames=1_000, level=level) for level in (0.0, 2.0))
    monkeypatch.setattr(never_worse, "TASKS", {"easy": easy, "hard": hard})
    never_worse.main(never_worse.Study(tasks=("easy", "hard"), runs=2, jobs=1, out=tmp_path))
    written = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    learned = {name: (each["learned_on"], each["learned_off"]) for name, each in written["summary"].items()}
    assert learned == {"easy": (2, 2), "hard": (0, 0)}
    assert written["summary"]["hard"]["steps"] == [1.0, 1.0, 1.0]  # both to the end
    for side in ("on", "off"):
        assert all(50 <= run["steps"] < 1_000 for run in written["runs"][f"easy, {side}"])
        assert all(run["seconds"] > 0 for run in written["runs"][f"hard, {side}"])
    assert not any(run["found"] for run in written["runs"]["hard, off"])


def test_a_cliff_has_a_last_step() -> None:
    env = gym.make(CLIFF)
    env.reset(seed=0)
    ends = [env.step(0)[2:4] for _ in range(CLIFF_STEPS)]  # up, along the wall
    assert ends == [(False, False)] * (CLIFF_STEPS - 1) + [(False, True)]


def test_the_point_maze_tells_where_the_ball_is() -> None:
    env = gym.make(POINT_MAZE)
    assert env.action_space == gym.spaces.Discrete(9)
    observation, _ = env.reset(seed=0)
    features = env.get_wrapper_attr("concept_features")({key: value[None] for key, value in observation.items()})
    assert features.tolist() == [observation["achieved_goal"].tolist()]
    env.close()
