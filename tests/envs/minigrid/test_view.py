"""What is seen quickly is what MiniGrid shows."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

minigrid_env: Any = pytest.importorskip("minigrid.minigrid_env")

from sb3_options.envs.minigrid import make, require  # noqa: E402
from sb3_options.envs.minigrid.view import image_of  # noqa: E402

TASKS = [
    "MiniGrid-DoorKey-8x8-v0",
    "MiniGrid-MultiRoom-N4-S5-v1",
    "MiniGrid-KeyCorridorS3R3-v0",
    "MiniGrid-LavaCrossingS9N2-v0",
    "MiniGrid-ObstructedMaze-2Dlh-v0",
    "MiniGrid-BlockedUnlockPickup-v0",
    "MiniGrid-Dynamic-Obstacles-6x6-v0",
]


@pytest.mark.parametrize("env_id", TASKS)
def test_images_are_those_of_minigrid(env_id: str) -> None:
    require()
    env: Any = gym.make(env_id)
    inner = env.unwrapped
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    carried = 0
    for _ in range(600):
        _, _, terminated, truncated, _ = env.step(rng.choice([0, 1, 2, 2, 2, 3, 3, 4, 5, 5]) % env.action_space.n)
        expected = minigrid_env.MiniGridEnv.gen_obs(inner)["image"]
        image = image_of(inner)
        np.testing.assert_array_equal(image, expected)
        assert image.dtype == expected.dtype
        assert image.flags.writeable
        carried += inner.carrying is not None
        if terminated or truncated:
            env.reset()


@pytest.mark.parametrize("again", [lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy], ids=["pickle", "copy"])
def test_a_copy_sees_what_is_around_itself(again: Callable[[Any], Any]) -> None:
    env: Any = make("MiniGrid-DoorKey-5x5-v0")
    before, _ = env.reset(seed=3)
    copied = again(env)
    for action in (0, 0, 2, 1):
        after = copied.step(action)[0]
    np.testing.assert_array_equal(env.unwrapped.gen_obs()["image"], env.images(before[None])[0])
    np.testing.assert_array_equal(copied.unwrapped.gen_obs()["image"], copied.images(after[None])[0])
    assert not np.array_equal(before, after)
