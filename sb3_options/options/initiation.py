"""The initiation set of an option, from saved trajectories."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.settings import OptionLearningSettings


def initiation_set(
    subgoal: Region, trajectories: Iterable[LabelledTrajectory], settings: OptionLearningSettings
) -> Region:
    """The union of the n states before a visit of the subgoal, over all saved trajectories.

    A region with one centre for every distinct state, in the features that an option for the subgoal sees; empty if no
    trajectory visits the subgoal.
    """
    trajectories = list(trajectories)
    points: list[FloatArray] = [t.features[:0] for t in trajectories[:1]] or [subgoal.points[:0]]
    for labelled in trajectories:
        visits = labelled.trajectory.visits
        times = np.flatnonzero(subgoal.contains(labelled.features)[visits])[:1]  # a later one may be from behind
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
