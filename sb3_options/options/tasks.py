"""The tasks that options are learned in, as steps of saved trajectories with rewards of their own."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.proposals import IntrinsicReward
from sb3_options.options.settings import OptionLearningSettings

STEP_REWARD, SUBGOAL_REWARD = -1.0, 0.0
"""Rewards of a step that goes on and of one that reaches the subgoal: the value of a state is minus the number of steps
from there, as in a shortest path (Sutton & Barto 2018, example 4.1)."""


class Transitions(NamedTuple):
    """Primitive steps of the option's own task, each distinct observation stored once.

    Attributes:
        states: The distinct observations, or features where the policy acts on those, batch of m.
        began: Row of ``states`` where each step began, shape (n,).
        actions: Primitive actions, shape (n,).
        rewards: Of the option's own task, shape (n,).
        led: Row of ``states`` where each step led, shape (n,).
        ends: Whether the step reached the subgoal, left I or ended the episode in a terminal state, shape (n,).
        stop: What ending the option in any state is worth; −∞ where it cannot be chosen.
    """

    states: Observations
    began: IntArray
    actions: IntArray
    rewards: FloatArray
    led: IntArray
    ends: BoolArray
    stop: float = -np.inf


Steps: TypeAlias = tuple[IntArray, FloatArray, BoolArray]
"""Those of a trajectory that belong to a task: when each began, its reward, and whether it ends the task, (k,) each."""


class Reaching:
    """Reach a region from within I, in as few steps as possible.

    Args:
        subgoal: Reaching it ends the task with `SUBGOAL_REWARD`.
        initiation: I. Leaving it ends the task with ``leave_reward``, and so does a terminal state.
        settings: ``leave_reward`` is used.
    """

    stop = -np.inf

    def __init__(self, subgoal: Region, initiation: Region, settings: OptionLearningSettings) -> None:
        self.subgoal, self.initiation, self.settings = subgoal, initiation, settings

    def steps(self, labelled: LabelledTrajectory) -> Steps:
        """The steps of a trajectory that began in I."""
        trajectory = labelled.trajectory
        reached = self.subgoal.contains(labelled.features)
        inside = self.initiation.contains(labelled.features) & ~reached
        began, led = trajectory.visits[:-1], trajectory.visits[1:]
        times = np.flatnonzero(inside[began])
        goes_on = inside[led]
        if trajectory.terminated:
            goes_on[-1] = False
        led, goes_on = led[times], goes_on[times]
        otherwise = np.where(goes_on, STEP_REWARD, self.settings.leave_reward)
        rewards = np.where(reached[led], SUBGOAL_REWARD, otherwise)
        return times, rewards, ~goes_on

    def own(self, features: FloatArray) -> FloatArray:
        """The features that count, of all features (m, d)."""
        return self.initiation.own(features)


class Climbing:
    """Gain an intrinsic reward, and stop where nothing is left to gain: stopping is worth 0.

    Args:
        reward: r(s, s') = f(s') − f(s). A step that begins or leads where f is not known is left out.
    """

    stop = 0.0

    def __init__(self, reward: IntrinsicReward) -> None:
        self.reward = reward

    def steps(self, labelled: LabelledTrajectory) -> Steps:
        """The steps of a trajectory between known places. A terminal state ends the task."""
        trajectory = labelled.trajectory
        rows, known = self.reward.rows(labelled.features)
        potentials = np.where(known, self.reward.potentials[rows], 0.0)
        began, led = trajectory.visits[:-1], trajectory.visits[1:]
        times = np.flatnonzero(known[began] & known[led])
        ends = np.zeros(len(began), dtype=bool)
        if trajectory.terminated:
            ends[-1] = True
        return times, (potentials[led] - potentials[began])[times], ends[times]

    def own(self, features: FloatArray) -> FloatArray:
        """All features count."""
        return features


OwnTask: TypeAlias = Reaching | Climbing
"""What an option is learned in; ``stop`` is what ending it in any state is worth, −∞ where it cannot be chosen."""


def transitions_of(
    task: OwnTask, trajectories: Iterable[LabelledTrajectory], settings: OptionLearningSettings
) -> Transitions | None:
    """Every saved primitive step that belongs to a task; None if there are none."""
    row_of: dict[bytes, int] = {}
    states: list[Observations] = []
    columns: list[tuple[IntArray, IntArray, FloatArray, IntArray, BoolArray]] = []
    for labelled in trajectories:
        trajectory = labelled.trajectory
        times, rewards, ends = task.steps(labelled)
        began, led = trajectory.visits[times], trajectory.visits[times + 1]
        seen = task.own(labelled.features) if settings.policy_input == "features" else trajectory.states
        shared_row = np.zeros(len(labelled.features), dtype=np.int64)
        for local in np.unique(np.concatenate([began, led])):
            state = obs_batch.take(seen, slice(local, local + 1))
            row = shared_row[local] = row_of.setdefault(obs_batch.value_key_of(state), len(row_of))
            if row == len(states):
                states.append(state)
        columns.append((shared_row[began], trajectory.actions[times], rewards, shared_row[led], ends))
    if not states:
        return None
    began, actions, rewards, led, ends = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Transitions(obs_batch.concatenate(states), began, actions, rewards, led, ends, task.stop)
