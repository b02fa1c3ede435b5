"""Demonstrations: options before the first step of a training."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.checkpoints.demonstrations import load_demonstrations
from sb3_options.execution.slots import Traits
from sb3_options.experience.observations import take
from sb3_options.experience.success import SuccessRule, judged
from sb3_options.experience.trajectories import Trajectory


def labelled(
    given: Iterable[Trajectory] | str | os.PathLike[str], venv: VecEnv, success: SuccessRule, seed: int
) -> list[tuple[Trajectory, bool]]:
    """Demonstrations with their labels, failures among successes.

    Where none of them failed, a random policy does, after which the environments have to be reset.

    Args:
        given: Trajectories, or the file that `save_demonstrations` wrote.
        venv: Of `OptionsWrapper`.
        success: Which of them succeeded.
        seed: Of the random policy.

    Raises:
        ValueError: They do not fit the environments, or none succeeded.
    """
    everything = load_demonstrations(given) if isinstance(given, str | os.PathLike) else list(given)
    traits: Traits = venv.get_attr("traits", [0])[0]
    for number, trajectory in enumerate(everything):
        _check(trajectory, number, traits)
    positive = [(each, True) for each in everything if judged(success, each)]
    negative = [(each, False) for each in everything if not judged(success, each)]
    if not positive:
        raise ValueError(
            f"None of the {len(everything)} demonstrations succeeded: say what success is, with "
            "SubgoalDiscoveryCallback(success=...) or train.py --success, or record others."
        )
    if not negative:
        failures = venv.env_method("random_trajectories", len(positive), seed, indices=[0])[0]
        negative = [(each, False) for each in failures]
    places = np.argsort(np.concatenate([np.linspace(0, 1, len(part)) for part in (negative, positive)]), kind="stable")
    return [[*negative, *positive][place] for place in places]


def _check(trajectory: Any, number: int, traits: Traits) -> None:
    if not isinstance(trajectory, Trajectory):
        raise TypeError(
            f"demonstrations must be trajectories, as record_demonstrations returns, got {trajectory!r:.80}"
        )
    space, first = traits.observation_space, take(trajectory.states, 0)
    fits = isinstance(first, dict) == isinstance(space, spaces.Dict) and space.contains(first)
    legal = np.isin(trajectory.actions, range(traits.n_primitive)).all()
    if not (fits and legal and np.isfinite(trajectory.rewards).all()):
        raise ValueError(
            f"Demonstration {number} does not fit the environment: its observations must be in {space}, its actions "
            f"from 0 to {traits.n_primitive - 1}, and its rewards finite."
        )
