"""`discover`: options from saved trajectories, without training."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import gymnasium as gym
from stable_baselines3 import DQN

from sb3_options.callbacks.discovery import SubgoalDiscoveryCallback
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.bank import OptionBank


def discover(
    trajectories: Iterable[Trajectory] | str | os.PathLike[str],
    env: gym.Env[Any, Any],
    *,
    seed: int = 0,
    **settings: Any,
) -> OptionBank:
    """Discover options in trajectories, as a training does in its own, and put them into an environment.

    It is a training of no steps: what is found, and why nothing is, is the same.

    Args:
        trajectories: What ``SubgoalDiscoveryCallback(demonstrations=...)`` takes.
        env: In an `OptionsWrapper`, whose slots are filled. It gives random failures where there are none.
        seed: Of everything random.
        **settings: Other arguments of `SubgoalDiscoveryCallback`.

    Returns:
        The options, which `OptionBank.save` writes.

    Raises:
        ValueError: The trajectories do not fit the environment, or none succeeded.
    """
    callback = SubgoalDiscoveryCallback(demonstrations=trajectories, **settings)
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
    gamma = env.get_wrapper_attr("gamma")
    DQN(policy, env, gamma=gamma, buffer_size=1, seed=seed).learn(0, callback)
    return callback.bank
