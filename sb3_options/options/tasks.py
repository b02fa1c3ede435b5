"""The task that an option is learned in: its initiation set, and the saved steps with the task's own rewards."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_options.density.arrays import distinct_rows, row_keys
from sb3_options.density.regions import Region
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.settings import OptionLearningSettings

STEP_REWARD, SUBGOAL_REWARD = -1.0, 0.0
"""Rewards of a step that goes on and of one that reaches the subgoal. So the value of a state is minus the number of
steps from there, as in a shortest path (Sutton & Barto 2018, example 4.1)."""

AT_ONCE = 2048  # states per call that checks whether a region contains them; bounds memory by this times its points


class Transitions(NamedTuple):
    """n primitive steps of the option's own task, each distinct observation stored once."""

    states: Observations  # the m distinct observations, or features if the policy acts on those
    began: IntArray  # row of ``states`` where each step began, (n,)
    actions: IntArray  # primitive ones, (n,)
    rewards: FloatArray  # of the option's own task, (n,)
    led: IntArray  # row of ``states`` where each step led, (n,)
    ends: BoolArray  # whether it reached the subgoal, left I or ended the episode in a terminal state, (n,)


def initiation_set(
    subgoal: Region, trajectories: Iterable[LabelledTrajectory], settings: OptionLearningSettings
) -> Region:
    """Return the union of the n states before a visit of the subgoal, over all saved trajectories.

    The region has one centre for every distinct state, in the features that an option for the subgoal sees. It is empty
    if no trajectory visits the subgoal.
    """
    trajectories = list(trajectories)
    if not trajectories:
        return _with_centres(subgoal.points[:0], subgoal, settings)
    visits, ends = _joined_visits(trajectories)
    features = np.concatenate([each.features for each in trajectories])
    visiting = np.flatnonzero(_contained(subgoal, features)[visits])
    # In each trajectory the first visit counts, because a later one may come from behind.
    which, first = np.unique(np.searchsorted(ends, visiting, side="right"), return_index=True)
    until = visiting[first]
    begin = np.maximum(until - settings.initiation_steps, np.concatenate([[0], ends])[which])
    before = [visits[:0], *(visits[i:j] for i, j in zip(begin, until, strict=True))]
    union = distinct_rows(features[np.unique(np.concatenate(before))])
    return _with_centres(union[~subgoal.contains(union)], subgoal, settings)


def _with_centres(outside: FloatArray, subgoal: Region, settings: OptionLearningSettings) -> Region:
    """Return the initiation set of places ``outside`` the subgoal, (n, d)."""
    if subgoal.group is None:
        return Region(outside, subgoal.scale, settings.initiation_radius)
    group = subgoal.group.sees
    outside = distinct_rows(group.own(outside[group.is_place(outside)]))
    scale = np.asarray(group.scale) * (subgoal.scale / np.asarray(subgoal.group.scale)).max()
    return Region(outside, scale, settings.initiation_radius, group=group)


def transitions_to(
    subgoal: Region, initiation: Region, trajectories: Iterable[LabelledTrajectory], settings: OptionLearningSettings
) -> Transitions | None:
    """Return every saved primitive step that begins in I and outside the subgoal, or None if there are none.

    Reaching the subgoal ends the task with `SUBGOAL_REWARD`. Leaving I ends it with ``leave_reward``, and so does a
    terminal state.
    """
    trajectories = list(trajectories)
    if not trajectories:
        return None
    visits, ends = _joined_visits(trajectories)
    features = np.concatenate([each.features for each in trajectories])
    reached = _contained(subgoal, features)
    inside = _contained(initiation, features) & ~reached
    begins = inside[visits]
    begins[ends - 1] = False  # a trajectory acts in all states that it visits but the last
    times = np.flatnonzero(begins)
    if not len(times):
        return None
    began, led = visits[times], visits[times + 1]
    actions = np.concatenate([each.trajectory.actions for each in trajectories])
    actions = actions[times - np.searchsorted(ends, times, side="right")]
    terminal = np.zeros(len(visits), dtype=bool)
    terminal[ends - 1] = [each.trajectory.terminated for each in trajectories]
    goes_on = inside[led] & ~terminal[times + 1]
    rewards = np.where(reached[led], SUBGOAL_REWARD, np.where(goes_on, STEP_REWARD, settings.leave_reward))
    used = np.zeros(len(features), dtype=bool)
    used[began] = used[led] = True
    which = np.flatnonzero(used)
    seen: Iterable[Observations] = [initiation.own(features[which])]
    if settings.policy_input != "features":  # trajectory by trajectory: images of all would take much memory
        parts = np.split(used, np.cumsum([len(each.features) for each in trajectories[:-1]]))
        pairs = zip(trajectories, parts, strict=True)
        seen = (obs_batch.take(each.trajectory.states, np.flatnonzero(of)) for each, of in pairs)
    row_of: dict[bytes, int] = {}
    rows: list[int] = []
    states: list[Observations] = []
    for part in seen:
        last = len(row_of) - 1
        its_rows = [row_of.setdefault(key, len(row_of)) for key in value_keys(part)]
        newest = np.maximum.accumulate([last, *its_rows])
        states.append(obs_batch.take(part, np.flatnonzero(np.diff(newest))))
        rows += its_rows
    row = np.zeros(len(features), dtype=np.int64)
    row[which] = rows
    return Transitions(obs_batch.concatenate(states), row[began], actions, rewards, row[led], ~goes_on)


def _joined_visits(trajectories: Sequence[LabelledTrajectory]) -> tuple[IntArray, IntArray]:
    """Return all visits as rows of the joined distinct states, and where each trajectory's visits end."""
    first = np.cumsum([0, *(len(each.features) for each in trajectories[:-1])])
    visits = [each.trajectory.visits for each in trajectories]
    lengths = list(map(len, visits))
    return np.concatenate(visits) + np.repeat(first, lengths), np.cumsum(lengths)


def value_keys(observations: Observations) -> list[bytes]:
    """Return a key for each observation; two of one space share a key exactly if their values are equal."""
    if isinstance(observations, Mapping):
        return list(map(b"".join, zip(*(value_keys(observations[k]) for k in sorted(observations)), strict=True)))
    return row_keys(observations.reshape(len(observations), math.prod(observations.shape[1:])))


def _contained(region: Region, features: FloatArray) -> BoolArray:
    """Return whether the region contains each place, (n,), with `AT_ONCE` places a call."""
    parts = range(0, max(len(features), 1), AT_ONCE)
    return np.concatenate([region.contains(features[begin : begin + AT_ONCE]) for begin in parts])
