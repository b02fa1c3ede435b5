"""The Pioneer's tasks, protocol and errors."""

import importlib
import math
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import sb3_options.envs
from sb3_options.envs.pioneer.env import GRIPPING, Pioneer, PioneerTask
from tests.envs.pioneer.expert import Expert, succeeds
from tests.envs.pioneer.simulators import needs_pybullet

NAMES = ["Pioneer", "PioneerCorner", "PioneerClutter", "PioneerTwoBalls"]
SHORT, MIDDLE, LONG, LEFT_10, LEFT_45, RIGHT_10, RIGHT_45 = range(7)


def make(name: str, **kwargs: Any) -> Pioneer:
    pytest.importorskip("pybullet")
    env = gymnasium.make(f"sb3_options/{name}-v0", **kwargs).unwrapped
    assert isinstance(env, Pioneer)
    return env


@pytest.mark.parametrize("kind", ["sensors", "retina"])
@pytest.mark.parametrize("name", NAMES)
def test_check_env(name: str, kind: str) -> None:
    # With pictures it would open Bullet's window: "human" has a test of its own.
    check_env(make(name, observation=kind), skip_render_check=True)
    sb3_check_env(make(name, observation=kind))


def test_why_an_episode_ended() -> None:
    env = make("PioneerCorner", max_steps=2)
    env.reset(options={"robot": (1.2, 1.75, 0), "balls": [(1.75, 1.75)]})
    assert env.step(MIDDLE)[4]["cause"] == ""
    assert env.step(LEFT_10)[4]["cause"] == "corner"
    env.reset(options={"robot": (0, 0, 0), "balls": [(-1, 0)]})
    assert [env.step(SHORT)[4]["cause"] for _ in range(2)] == ["", "step limit"]
    env.close()


def test_rewards_from_start_to_success(env: PioneerTask) -> None:
    """Find the ball, grip it, leave it at the wall: worked out by hand."""
    env.reset(options={"robot": (0, 0, 0), "balls": [(0.8, 0)]})
    idle = {"is_success": False, "deposited": False, "touched_wall": False, "cause": ""}
    assert env.step(SHORT)[1:] == (-0.1, False, False, {**idle, "gripping": False})
    assert env.step(LONG)[1:] == (-0.1, False, False, {**idle, "gripping": True})
    assert env.step(MIDDLE)[1:] == (-0.1, False, False, {**idle, "gripping": True})
    # The ball's centre is at 0.95 + 0.31 m, its surface 0.66 m from the wall.
    assert env.step(MIDDLE)[1:] == (-0.1, False, False, {**idle, "gripping": True})
    observation, reward, terminated, truncated, info = env.step(MIDDLE)
    assert (terminated, truncated) == (True, False)
    assert reward == pytest.approx(9.9)
    assert info == {"is_success": True, "deposited": True, "gripping": False, "touched_wall": False, "cause": "wall"}
    assert observation[GRIPPING] == 0


def test_only_the_marked_corner_counts() -> None:
    env = make("PioneerCorner")
    for x, success in ((0.0, False), (1.5, True), (-1.5, False)):
        env.reset(options={"robot": (x, 0.6, math.pi / 2), "balls": [(x, 1.2)]})
        env.step(MIDDLE)
        _, reward, terminated, _, info = env.step(MIDDLE)
        while not terminated and not info["touched_wall"]:
            _, reward, terminated, _, info = env.step(SHORT)
        assert terminated == success
        assert (reward > 9) == success
        assert info["gripping"] == (not success)
    env.close()


@needs_pybullet
def test_an_obstacle_is_no_wall_to_deposit_at() -> None:
    env = Pioneer(n_obstacles=1)
    env.reset(options={"robot": (-0.6, 0, 0), "balls": [(0, 0)], "obstacles": [(0.6, 0)]})
    assert env.step(MIDDLE)[4]["gripping"]
    info = env.step(MIDDLE)[4]
    assert info["gripping"]
    assert not info["deposited"]
    env.close()


@pytest.mark.parametrize("name", NAMES)
def test_an_expert_solves_it(name: str) -> None:
    env = make(name)
    expert = Expert(corner=name == "PioneerCorner")
    assert sum(succeeds(env, expert, seed) for seed in range(10)) >= 9
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_an_expert_solves_95_percent(name: str) -> None:
    env = make(name)
    expert = Expert(corner=name == "PioneerCorner")
    assert np.mean([succeeds(env, expert, seed) for seed in range(1000, 1100)]) >= 0.95
    env.close()


@needs_pybullet
@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"arena_size": 1.2}, ValueError, r"arena_size 1\.2 m has no room for the robot, 1 ball\(s\) and 0 obst"),
        ({"n_obstacles": 40}, ValueError, r"no room for .* 40 obstacle\(s\): enlarge arena_size, or lower"),
        ({"arena_size": math.nan}, ValueError, r"arena_size must be in 0..100.0, got nan"),
        ({"n_balls": 0}, ValueError, r"n_balls must be at least 1, got 0"),
        ({"deposit": "door"}, ValueError, r"deposit must be one of 'wall', 'corner', got 'door'"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        Pioneer(**kwargs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ball": (0, 0)}, r"options has the unknown key 'ball': only 'robot', 'balls', 'obstacles'"),
        ({"balls": (1, 1)}, r"options\['balls'\] must be finite numbers of shape \(1, 2\), got \(1, 1\)"),
        ({"robot": (0, 0, math.nan)}, r"options\['robot'\] must be finite numbers of shape \(3,\)"),
        ({"robot": (1.9, 0, 3.1)}, r"the robot at \(1\.90, 0\.00\) m is in a wall of the arena, which ends at ±2 m"),
        ({"robot": (1.7, 0, 0)}, r"the robot's gripper at \(1\.98, 0\.00\) m is in a wall"),
        ({"robot": (0, 0, 0), "balls": [(0.2, 0)]}, r"balls\[0\] at \(0\.20, 0\.00\) m overlaps the robot"),
    ],
)
def test_bad_reset_options(env: PioneerTask, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0, options=options)


@pytest.mark.parametrize("action", [-1, 7, 1.0, None, np.array([1, 2])])
def test_bad_actions(env: PioneerTask, action: Any) -> None:
    env.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction, match=r"action must be an integer in 0\.\.6, got "):
        env.step(action)


def test_step_before_reset_and_after_the_end() -> None:
    env = make("Pioneer", max_steps=1)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"step\(\) was called before the first reset\(\)"):
        env.step(0)
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"after the episode's end: call reset\(\) first"):
        env.step(0)
    env.close()


def test_without_pybullet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    importlib.reload(sb3_options.envs)
    said = r"pip install 'sb3-options\[pioneer\]'.*sb3_options/PioneerMuJoCo-v0.*pip install 'sb3-options\[mujoco\]'"
    with pytest.raises(gymnasium.error.DependencyNotInstalled, match=said):
        Pioneer()
