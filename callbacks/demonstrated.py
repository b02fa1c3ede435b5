"""Demonstrations: options before the first step of a training."""

import os
from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.checkpoints.demonstrations import load_demonstrations
from sb3_options.execution.slots import Traits
from sb3_options.experience.observations import batch_size, take
from sb3_options.experience.success import SuccessRule, judged
from sb3_options.experience.trajectories import Trajectory

FAILURES = 20  # most episodes of a random policy


def labelled(
    given: Iterable[Trajectory] | str | os.PathLike[str], venv: VecEnv, success: SuccessRule
) -> list[tuple[Trajectory, bool]]:
    """Return the demonstrations, and which succeeded. Refuse any that do not fit, and a set without a success."""
    everything = load_demonstrations(given) if isinstance(given, str | os.PathLike) else list(given)
    traits: Traits = venv.get_attr("traits", [0])[0]
    for number, trajectory in enumerate(everything):
        _check(trajectory, number, traits)
    shown = [(each, judged(success, each)) for each in everything]
    if not any(said for _, said in shown):
        raise ValueError(
            f"None of the {len(everything)} demonstrations succeeded: say what success is, with "
            "SubgoalDiscoveryCallback(success=...) or train.py --success, or record others."
        )
    return shown


def with_failures(
    shown: list[tuple[Trajectory, bool]], venv: VecEnv, success: SuccessRule, seed: int
) -> list[tuple[Trajectory, bool]]:
    """Failures among successes, to learn from in this order.

    If no demonstration failed, as many episodes of a random policy are added, at most `FAILURES`. Each is at most as
    long as the longest demonstration, so few succeed; those that do count as successes. Reset the environments
    afterwards.
    """
    if all(said for _, said in shown):
        longest = max(len(each) for each, _ in shown)
        walks = venv.env_method("random_trajectories", min(len(shown), FAILURES), longest, seed, indices=[0])[0]
        # A rule might take one that was cut off for a success.
        ended = (each.terminated or len(each) < longest for each in walks)
        shown = [*shown, *((each, whole and judged(success, each)) for each, whole in zip(walks, ended, strict=True))]
    parts = [[each for each in shown if each[1] == said] for said in (False, True)]
    places = np.argsort(np.concatenate([np.linspace(0, 1, len(part)) for part in parts]), kind="stable")
    return [[*parts[0], *parts[1]][place] for place in places]


def _check(trajectory: Any, number: int, traits: Traits) -> None:
    if not isinstance(trajectory, Trajectory):
        raise TypeError(
            f"demonstrations must be trajectories, as record_demonstrations returns, got {trajectory!r:.80}"
        )
    space = traits.observation_space
    first = take(trajectory.states, 0)
    fits = isinstance(first, dict) == isinstance(space, spaces.Dict) and space.contains(first)
    n_states = batch_size(trajectory.states)
    in_order = np.array_equal(trajectory.visits[np.sort(trajectory.arrivals)], range(n_states))  # and none is left out
    whole = in_order and len(trajectory.visits) == len(trajectory) + 1 == len(trajectory.rewards) + 1
    legal = np.isin(trajectory.actions, range(traits.n_primitive)).all()
    if not (fits and whole and legal and np.isfinite(trajectory.rewards).all()):
        raise ValueError(
            f"Demonstration {number} does not fit the environment: its observations must be in {space}, its actions "
            f"from 0 to {traits.n_primitive - 1}, its rewards finite, and its states in order of first visit, with a "
            "visit before and after every action."
        )
