"""The initiation set of an option and the transitions of its own task, both from saved trajectories."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.settings import OptionLearningSettings


class Transitions(NamedTuple):
    """Primitive steps of the option's own task, each distinct observation stored once.

    Attributes:
        states: The distinct observations, or features where the policy acts on those, batch of m.
        began: Row of ``states`` where each step began, shape (n,).
        actions: Primitive actions, shape (n,).
        rewards: Of the option's own task, shape (n,).
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
    """The union of the n states before a visit of the subgoal, over all saved trajectories.

    Args:
        subgoal: In concept space.
        trajectories: All of them, successful or not.
        settings: ``initiation_steps``, ``initiation_visits`` and ``initiation_radius`` are used.

    Returns:
        A region with one centre for every distinct state, in the features that count for the subgoal; empty if no
        trajectory visits the subgoal.
    """
    trajectories = list(trajectories)
    points: list[FloatArray] = [t.features[:0] for t in trajectories[:1]] or [subgoal.points[:0]]
    for labelled in trajectories:
        visits = labelled.trajectory.visits
        times = np.flatnonzero(subgoal.contains(labelled.features)[visits])
        if settings.initiation_visits == "first":
            times = times[:1]
        before = np.unique(
            [row for t in times for row in visits[max(0, t - settings.initiation_steps) : t]],
        ).astype(np.int64)
        points.append(labelled.features[before])
    union = np.unique(np.concatenate(points), axis=0)
    outside = union[~subgoal.contains(union)]
    group = subgoal.group
    if group is not None:
        outside = np.unique(group.own(outside[group.is_place(outside)]), axis=0)
    return Region(outside, subgoal.scale, settings.initiation_radius, group=group)


def option_transitions(
    subgoal: Region,
    initiation: Region,
    trajectories: Iterable[LabelledTrajectory],
    settings: OptionLearningSettings,
) -> Transitions | None:
    """Every saved primitive step that began in I, with the rewards of the option's own task.

    Args:
        subgoal: Reaching it ends the task with ``subgoal_reward``.
        initiation: Leaving it ends the task with ``leave_reward``, and so does a terminal state.
        trajectories: The saved ones.
        settings: The rewards and ``policy_input`` are used; features are those that count for the subgoal.

    Returns:
        The steps; None if there are none.
    """
    row_of: dict[bytes, int] = {}
    states: list[Observations] = []
    columns: list[tuple[IntArray, IntArray, FloatArray, IntArray, BoolArray]] = []
    for labelled in trajectories:
        trajectory = labelled.trajectory
        reached = subgoal.contains(labelled.features)
        inside = initiation.contains(labelled.features) & ~reached
        began, led = trajectory.visits[:-1], trajectory.visits[1:]
        keep = np.flatnonzero(inside[began])
        goes_on = inside[led]
        if trajectory.terminated:
            goes_on[-1] = False
        began, led, goes_on = began[keep], led[keep], goes_on[keep]
        seen = subgoal.own(labelled.features) if settings.policy_input == "features" else trajectory.states
        shared_row = np.zeros(len(inside), dtype=np.int64)
        for local in np.unique(np.concatenate([began, led])):
            state = obs_batch.take(seen, slice(local, local + 1))
            row = shared_row[local] = row_of.setdefault(obs_batch.key_of(state), len(row_of))
            if row == len(states):
                states.append(state)
        rewards = np.where(
            reached[led],
            settings.subgoal_reward,
            np.where(goes_on, settings.step_reward, settings.leave_reward),
        )
        columns.append((shared_row[began], trajectory.actions[keep], rewards, shared_row[led], ~goes_on))
    if not states:
        return None
    began, actions, rewards, led, ends = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Transitions(obs_batch.concatenate(states), began, actions, rewards, led, ends)
