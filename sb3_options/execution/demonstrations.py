"""Demonstrations: trajectories of another policy."""

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.trajectories import Trajectory


def record_demonstrations(
    env: gym.Env[Any, Any], policy: Callable[[Any], Any] | Any, episodes: int = 20, *, seed: int = 0
) -> list[Trajectory]:
    """Record episodes of a policy, for ``SubgoalDiscoveryCallback(demonstrations=...)``.

    Args:
        env: Environment with discrete actions and a time limit. It gets an `OptionsWrapper` if it has none.
        policy: Policy from one observation to an action: a function or an SB3 model. A function that plans with the
            state of the environment, or asks a person, holds ``env`` itself. A model samples its actions, as in
            training, with the environment's masks, its memory, and the ``VecNormalize`` of its own environment.
        episodes: Number of episodes.
        seed: Seed of the first reset; later resets use ``seed + 1`` and so on.

    Returns:
        The episodes in primitive steps, successful or not.

    Raises:
        ValueError: The policy chose an action that the environment does not have, or the model was trained with slots
            or stacked frames that the environment lacks.
    """
    if not env.has_wrapper_attr("random_trajectories"):
        env = OptionsWrapper(env, 0)
    act = _acting(policy, env) if hasattr(policy, "predict") else lambda observation, _: policy(observation)
    env.get_wrapper_attr("set_slots")(record=True)
    trajectories = []
    for episode in range(episodes):
        observation, info = env.reset(seed=seed + episode)
        begins, ended = True, False
        while not ended:
            observation, _, terminated, truncated, info = env.step(act(observation, begins))
            begins, ended = False, terminated or truncated
        if "trajectory" in info:  # an episode that was too long is dropped
            trajectories.append(info["trajectory"])
    return trajectories


def _acting(model: Any, env: gym.Env[Any, Any]) -> Callable[[Any, bool], Any]:
    """Return a function of an observation, and of whether an episode begins, to the action that a model chooses."""
    takes = inspect.signature(model.predict).parameters
    n_actions = getattr(getattr(model, "action_space", None), "n", None)
    if n_actions is not None and n_actions > env.action_space.n:  # type: ignore[attr-defined]  # OptionsWrapper checked it
        raise ValueError(
            f"The model has {n_actions} actions, the environment fewer: wrap it in OptionsWrapper as before."
        )
    normalizer = model.get_vec_normalize_env() if hasattr(model, "get_vec_normalize_env") else None
    if normalizer is not None and normalizer.venv.observation_space != env.observation_space:
        raise ValueError(
            f"The model sees {normalizer.venv.observation_space}, and the environment returns {env.observation_space}: "
            "pass a function that turns an observation into what the model sees."
        )
    memory: Any = None

    def act(observation: Any, begins: bool) -> Any:
        nonlocal memory
        seen = observation if normalizer is None else normalizer.normalize_obs(observation)
        given = {"state": None if begins else memory, "episode_start": np.array([begins])}
        if "action_masks" in takes:  # slots beyond the model's own actions stay empty for it
            given["action_masks"] = env.get_wrapper_attr("action_masks")()[:n_actions]
        action, memory = model.predict(seen, **{name: value for name, value in given.items() if name in takes})
        return action

    return act
