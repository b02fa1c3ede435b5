"""Finds the options that a trajectory passes through, as an agent with options would that acts the same."""

import numpy as np

from sb3_options.experience.observations import BoolArray, IntArray
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option


def explained(trajectory: Trajectory, bank: OptionBank) -> tuple[IntArray, BoolArray]:
    """Return how many steps of a trajectory each augmented action explains, and which actions are available.

    A primitive explains its own step. An option explains the steps to its subgoal if it may start there and its policy
    takes the same primitive actions. The numbers of steps have the shape (T, n_primitive + max_options), 0 for none.
    The masks are those at each of the T + 1 observations.
    """
    masks = bank.available(trajectory.states)[trajectory.visits]
    durations = np.zeros((len(trajectory), masks.shape[1]), dtype=np.int64)
    durations[np.arange(len(trajectory)), trajectory.actions] = 1
    for slot in bank.filled:
        option = bank[slot]
        assert option is not None  # it is filled
        action = bank.n_primitive + slot
        durations[:, action] = _durations(option, trajectory, masks[:, action])
    return durations, masks


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
