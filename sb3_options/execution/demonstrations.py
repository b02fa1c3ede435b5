"""Demonstrations: trajectories of another policy."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym

from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.trajectories import Trajectory


def record_demonstrations(
    env: gym.Env[Any, Any], policy: Callable[[Any], Any] | Any, episodes: int = 20, *, seed: int = 0
) -> list[Trajectory]:
    """Record episodes of a policy, for ``SubgoalDiscoveryCallback(demonstrations=...)``.

    Args:
        env: Environment with discrete actions and a time limit. It gets an `OptionsWrapper` if it has none.
        policy: Policy from one observation to an action: an SB3 model, or a function. A function that plans with the
            state of the environment, or asks a person, holds ``env`` itself.
        episodes: Number of episodes.
        seed: Seed of the first reset; later resets use ``seed + 1`` and so on.

    Returns:
        The episodes in primitive steps, successful or not.

    Raises:
        ValueError: The policy chose an action that the environment does not have.
    """
    if not env.has_wrapper_attr("random_trajectories"):
        env = OptionsWrapper(env, 0)
    act = (lambda observation: policy.predict(observation)[0]) if hasattr(policy, "predict") else policy
    env.get_wrapper_attr("set_slots")(record=True)
    trajectories = []
    for episode in range(episodes):
        observation, info = env.reset(seed=seed + episode)
        ended = False
        while not ended:
            observation, _, terminated, truncated, info = env.step(act(observation))
            ended = terminated or truncated
        if "trajectory" in info:  # an episode that was too long is dropped
            trajectories.append(info["trajectory"])
    return trajectories
