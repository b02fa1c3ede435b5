"""Finds the options that a trajectory passes through: the decisions of an agent with options that acts the same."""

from __future__ import annotations

import numpy as np

from sb3_options.experience.observations import BoolArray, IntArray
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option


def decisions(trajectory: Trajectory, bank: OptionBank) -> tuple[IntArray, BoolArray]:
    """Return the augmented action that explains each step of a trajectory, and the available actions.

    This is the option that takes the trajectory farthest. It may start there, and its policy takes the same primitive
    actions until its subgoal. Without such an option, it is the primitive action itself.

    Args:
        trajectory: Trajectory of T primitive steps.
        bank: The options.

    Returns:
        Augmented actions, (T,), and masks, (T, n_primitive + max_options).
    """
    n_steps = len(trajectory)
    masks = bank.available(trajectory.states)[trajectory.visits]
    actions = trajectory.actions.copy()
    farthest = np.ones(n_steps, dtype=np.int64)
    for slot in bank.filled:
        option = bank[slot]
        assert option is not None  # it is filled
        action = bank.n_primitive + slot
        for step, duration in enumerate(_durations(option, trajectory, masks[:, action])):
            if duration > farthest[step]:
                farthest[step] = duration
                actions[step] = action
    return actions, masks[:-1]


def _durations(option: Option, trajectory: Trajectory, available: BoolArray) -> IntArray:
    """Return how many steps of a trajectory the option explains from each step on, (T,); 0 for none."""
    visits = trajectory.visits
    agrees = available[:-1] & (option.policy(trajectory.states)[visits[:-1]] == trajectory.actions)
    reached = option.termination(trajectory.states)[visits] > 0
    durations = np.zeros(len(trajectory) + 1, dtype=np.int64)
    for step in reversed(range(len(trajectory))):
        if agrees[step]:
            durations[step] = 1 if reached[step + 1] else durations[step + 1] + (durations[step + 1] > 0)
    durations[durations > option.max_duration] = 0
    return durations[:-1]
