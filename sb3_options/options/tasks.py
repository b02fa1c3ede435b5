"""The task that an option is learned in: its initiation set, and the saved steps with the task's own rewards."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_options.density.arrays import row_keys
from sb3_options.density.regions import Region
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.options.settings import OptionLearningSettings

STEP_REWARD, SUBGOAL_REWARD = -1.0, 0.0
"""Rewards of a step that goes on and of one that reaches the subgoal. So the value of a state is minus the number of
steps from there, as in a shortest path (Sutton & Barto 2018, example 4.1)."""

AT_ONCE = 2048
"""States per call that checks whether a region contains them. It bounds memory by this times the region's points."""


class Transitions(NamedTuple):
    """Primitive steps of the option's own task, each distinct observation stored once.

    Attributes:
        states: The distinct observations, or features if the policy acts on those, batch of m.
        began: Row of ``states`` where each step began, shape (n,).
        actions: Primitive actions, shape (n,).
        rewards: Rewards of the option's own task, shape (n,).
        led: Row of ``states`` where each step led, shape (n,).
        ends: Whether the step reached the subgoal, left I or ended the episode in a terminal state, shape (n,).
    """

    states: Observations
    began: IntArray
    actions: IntArray
    rewards: FloatArray
    led: IntArray
    ends: BoolArray


def initiation_set(
    subgoal: Region, trajectories: Iterable[LabelledTrajectory], settings: OptionLearningSettings
) -> Region:
    """Return the union of the n states before a visit of the subgoal, over all saved trajectories.

    The region has one centre for every distinct state, in the features that an option for the subgoal sees. It is empty
    if no trajectory visits the subgoal.
    """
    trajectories = list(trajectories)
    points: list[FloatArray] = [t.features[:0] for t in trajectories[:1]] or [subgoal.points[:0]]
    for labelled, reached in zip(trajectories, contained(subgoal, trajectories), strict=True):
        visits = labelled.trajectory.visits
        times = np.flatnonzero(reached[visits])[:1]  # a later visit may come from behind
        before = np.unique(
            [row for t in times for row in visits[max(0, t - settings.initiation_steps) : t]],
        ).astype(np.int64)
        points.append(labelled.features[before])
    union = np.unique(np.concatenate(points), axis=0)
    outside = union[~subgoal.contains(union)]
    if subgoal.group is None:
        return Region(outside, subgoal.scale, settings.initiation_radius)
    group = subgoal.group.sees
    outside = np.unique(group.own(outside[group.is_place(outside)]), axis=0)
    scale = np.asarray(group.scale) * (subgoal.scale / np.asarray(subgoal.group.scale)).max()
    return Region(outside, scale, settings.initiation_radius, group=group)


def transitions_to(
    subgoal: Region,
    initiation: Region,
    trajectories: Iterable[LabelledTrajectory],
    settings: OptionLearningSettings,
) -> Transitions | None:
    """Return every saved primitive step that begins in I and outside the subgoal, or None if there are none.

    Reaching the subgoal ends the task with `SUBGOAL_REWARD`. Leaving I ends it with ``leave_reward``, and so does a
    terminal state.
    """
    trajectories = list(trajectories)
    row_of: dict[bytes, int] = {}
    states: list[Observations] = []
    columns: list[tuple[IntArray, IntArray, FloatArray, IntArray, BoolArray]] = []
    both = zip(contained(subgoal, trajectories), contained(initiation, trajectories), strict=True)
    for labelled, (reached, within) in zip(trajectories, both, strict=True):
        trajectory = labelled.trajectory
        times, rewards, ends = _steps(trajectory, reached, within & ~reached, settings.leave_reward)
        if not len(times):
            continue
        began, led = trajectory.visits[times], trajectory.visits[times + 1]
        seen = initiation.own(labelled.features) if settings.policy_input == "features" else trajectory.states
        row = np.full(len(labelled.features), -1)
        row[began] = row[led] = 0
        which = np.flatnonzero(row == 0)
        last_known = len(row_of) - 1
        row[which] = [row_of.setdefault(k, len(row_of)) for k in value_keys(obs_batch.take(seen, which))]
        newest = np.maximum.accumulate([last_known, *row[which]])
        states.append(obs_batch.take(seen, which[np.diff(newest) > 0]))
        columns.append((row[began], trajectory.actions[times], rewards, row[led], ends))
    if not states:
        return None
    began, actions, rewards, led, ends = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Transitions(obs_batch.concatenate(states), began, actions, rewards, led, ends)


def value_keys(observations: Observations) -> list[bytes]:
    """Return a key for each observation; two of one space share a key exactly if their values are equal."""
    if isinstance(observations, Mapping):
        return list(map(b"".join, zip(*(value_keys(observations[k]) for k in sorted(observations)), strict=True)))
    return row_keys(observations.reshape(len(observations), math.prod(observations.shape[1:])))


def contained(region: Region, trajectories: Sequence[LabelledTrajectory]) -> list[BoolArray]:
    """Return whether the region contains each distinct state of each trajectory, (m,) each, in few calls."""
    ends = np.cumsum([0, *(len(each.features) for each in trajectories)])
    parts: list[BoolArray] = []
    while len(parts) < len(trajectories):
        begin = len(parts)
        end = max(int(np.searchsorted(ends, ends[begin] + AT_ONCE, side="right")) - 1, begin + 1)
        features = np.concatenate([each.features for each in trajectories[begin:end]])
        parts += np.split(region.contains(features), ends[begin + 1 : end] - ends[begin])
    return parts


def _steps(
    trajectory: Trajectory, reached: BoolArray, inside: BoolArray, leave_reward: float
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return when each step of a trajectory's task began, its reward, and whether it ends the task, (k,) each."""
    began, led = trajectory.visits[:-1], trajectory.visits[1:]
    times = np.flatnonzero(inside[began])
    goes_on = inside[led]
    if trajectory.terminated:
        goes_on[-1] = False
    led, goes_on = led[times], goes_on[times]
    otherwise = np.where(goes_on, STEP_REWARD, leave_reward)
    return times, np.where(reached[led], SUBGOAL_REWARD, otherwise), ~goes_on
