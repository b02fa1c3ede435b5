"""`discover`: options from saved trajectories, without training."""

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
    """Discover options in saved trajectories, and put them into an environment.

    This is `SubgoalDiscoveryCallback` without training: the same options, or the same reason why there are none.

    Args:
        trajectories: Trajectories or a file, as in ``SubgoalDiscoveryCallback(demonstrations=...)``.
        env: Environment in an `OptionsWrapper`, whose slots are filled. It provides random failures if there are none.
        seed: Seed of everything random.
        **settings: Other arguments of `SubgoalDiscoveryCallback`.

    Returns:
        The options, which `OptionBank.save` writes.

    Raises:
        ValueError: The trajectories do not fit the environment, none succeeded, or the environment has no slots.
    """
    wrapped = isinstance(env, gym.Env) and env.has_wrapper_attr("bank")
    if not (wrapped and env.get_wrapper_attr("bank").max_options):
        raise ValueError("discover() needs an environment with slots: pass OptionsWrapper(env, max_options=4).")
    callback = SubgoalDiscoveryCallback(demonstrations=trajectories, **{**settings, "clone": False})
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
    gamma = env.get_wrapper_attr("gamma")
    DQN(policy, env, gamma=gamma, buffer_size=1, seed=seed).learn(0, callback)
    return callback.bank
