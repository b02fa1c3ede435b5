"""The twin in MuJoCo: it moves and senses like the robot in PyBullet, and goes on from a state exactly."""

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as sb3_check_env

pytest.importorskip("mujoco")

from sb3_options.envs.pioneer import Pioneer, PioneerMuJoCo
from sb3_options.envs.pioneer.env import ACTIONS, PioneerTask
from sb3_options.envs.pioneer.senses import SONARS
from sb3_options.execution import layers
from tests.envs.pioneer.expert import Expert
from tests.envs.pioneer.simulators import needs_pybullet

TASKS: dict[str, dict[str, Any]] = {
    "Pioneer": {},
    "PioneerCorner": {"deposit": "corner"},
    "PioneerClutter": {"n_obstacles": 4},
    "PioneerTwoBalls": {"n_balls": 2},
}


def both(**kwargs: Any) -> tuple[PioneerTask, PioneerTask]:
    return Pioneer(**kwargs), PioneerMuJoCo(**kwargs)


@pytest.mark.parametrize("kind", ["sensors", "retina"])
@pytest.mark.parametrize("name", TASKS)
def test_check_env(name: str, kind: Any) -> None:
    env = gymnasium.make("sb3_options/PioneerMuJoCo-v0", **TASKS[name], observation=kind, render_mode="rgb_array")
    check_env(env.unwrapped)
    sb3_check_env(PioneerMuJoCo(**TASKS[name], observation=kind))


@needs_pybullet
@pytest.mark.parametrize("name", TASKS)
def test_a_pose_looks_the_same_in_both(name: str) -> None:
    """Starts of a seed are the same. Sonars to 5 mm, all else to 1e-4.

    Bullet's rays meet round obstacles up to 2 mm off, and so now and then one ray more or less of a ball's sixteen.
    """
    env = gymnasium.make(f"sb3_options/{name}-v0", observation="retina")
    twin = PioneerMuJoCo(**TASKS[name], observation="retina")
    assert env.observation_space == twin.observation_space
    assert env.action_space == twin.action_space
    seen = [[each.reset(seed=seed)[0] for each in (env, twin)] for seed in range(60)]
    differences = np.array([np.abs(one - other) for one, other in seen])
    n_sonars = len(SONARS)
    assert differences[:, :n_sonars].max() < (0.005 if name == "PioneerClutter" else 1e-4)
    same = (differences[:, n_sonars:] < 1e-4).all(axis=1)
    assert same.mean() >= (0.95 if name == "PioneerClutter" else 1)
    env.close()


@needs_pybullet
@pytest.mark.parametrize("action", range(len(ACTIONS)))
def test_an_action_ends_where_it_ends_in_pybullet(action: int) -> None:
    ends, ticks = [], []
    for env in both(max_steps=None):
        n: list[int] = []
        env._robot.on_tick = lambda n=n: n.append(1)
        env.reset(options={"robot": (-0.3, 0, 0.5), "balls": [(-1.5, -1.5)]})
        for _ in range(2):
            env.step(action)
        ends.append(env.robot_pose)
        ticks.append(len(n))
        env.close()
    assert math.dist(ends[0][:2], ends[1][:2]) < 0.012
    assert abs(ends[0][2] - ends[1][2]) < math.radians(1.2)
    assert abs(ticks[0] - ticks[1]) <= 6


def moment(steps: int, **kwargs: Any) -> tuple[gymnasium.Env[Any, Any], NDArray[np.float32]]:
    """An environment with two balls in mid-episode, prepared for checkpoints."""
    env = layers.prepare(gymnasium.make("sb3_options/PioneerMuJoCo-v0", n_balls=2, n_obstacles=2, **kwargs))
    observation, _ = env.reset(seed=5)
    expert = Expert()
    for _ in range(steps):
        observation = env.step(expert.act(observation))[0]
    return env, observation


def onward(env: gymnasium.Env[Any, Any], observation: NDArray[np.float32]) -> list[Any]:
    """What comes next, on into another episode; and how it looks."""
    expert = Expert(seed=1)
    seen: list[Any] = []
    core = env.unwrapped
    assert isinstance(core, PioneerTask)
    for _ in range(60):
        observation, reward, terminated, truncated, info = env.step(expert.act(observation))
        seen.append((observation.tobytes(), reward, terminated, info, core.robot_pose, core.ball_positions))
        if terminated or truncated:
            observation = env.reset()[0]
            seen.append(observation.tobytes())
    return [*seen, np.asarray(env.render()).tobytes()]


@pytest.mark.parametrize("steps", [0, 3, 8, 14, 20])
def test_goes_on_from_a_state_bit_for_bit(steps: int) -> None:
    env, observation = moment(steps, render_mode="rgb_array")
    states, picture = layers.states_of(env), np.asarray(env.render())
    there = onward(env, observation)
    copy, _ = moment(9, render_mode="rgb_array")
    assert layers.set_states(copy, states) is None
    np.testing.assert_array_equal(np.asarray(copy.render()), picture)
    assert onward(copy, observation) == there
