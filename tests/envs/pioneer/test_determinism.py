"""One seed, one trajectory: bit for bit, whatever was simulated before, in one process or several."""

import hashlib
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pytest

from sb3_options.envs.pioneer.env import PioneerTask

IDS = [
    f"sb3_options/{name}-v0"
    for module, names in {
        "pybullet": ("Pioneer", "PioneerCorner", "PioneerClutter", "PioneerTwoBalls"),
        "mujoco": ("PioneerMuJoCo",),
    }.items()
    for name in names
    if find_spec(module) is not None
]
N_STEPS = 60
SEED = 3


def make(env_id: str) -> gymnasium.Env[Any, Any]:
    # Truncating early, so that several resets are part of the trajectory.
    return gymnasium.make(env_id, max_steps=20, observation="retina")


def digest(env: gymnasium.Env[Any, Any], seed: int) -> str:
    """Of all that a trajectory shows, and of the hidden positions."""
    actions = np.random.default_rng(seed).integers(7, size=N_STEPS)
    core = env.unwrapped
    assert isinstance(core, PioneerTask)
    sha = hashlib.sha256(env.reset(seed=seed)[0].tobytes())
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        sha.update(observation.tobytes())
        sha.update(repr((reward, terminated, truncated, info, core.robot_pose, core.ball_positions)).encode())
        if terminated or truncated:
            sha.update(env.reset()[0].tobytes())
    return sha.hexdigest()


@pytest.mark.parametrize("env_id", IDS)
def test_any_history(env_id: str) -> None:
    first = make(env_id)
    expected = digest(first, SEED)
    second = make(env_id)
    for seed in (7, 8):
        digest(second, seed)
    second.reset(seed=0)
    for _ in range(5):
        second.step(2)
    assert digest(second, SEED) == expected
    assert digest(first, SEED) == expected
    assert digest(first, SEED + 1) != expected
    first.close()
    second.close()
