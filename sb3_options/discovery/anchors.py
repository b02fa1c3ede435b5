"""The observations behind points of concept space, for a space that moves because its feature map is learned on."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FeatureMap, FloatArray, Observations, concatenate, take
from sb3_options.experience.trajectories import LabelledTrajectory


def nearest_observations(points: FloatArray, trajectories: Iterable[LabelledTrajectory]) -> Observations:
    """The observations whose features are nearest to some points of concept space."""
    least = np.full(len(points), np.inf)
    nearest: list[Observations | None] = [None] * len(points)
    for labelled in trajectories:
        distances = cdist(points, labelled.features)
        rows = distances.argmin(axis=1)
        for i in np.flatnonzero(distances.min(axis=1) < least):
            least[i] = distances[i, rows[i]]
            nearest[i] = take(labelled.trajectory.states, rows[i : i + 1])
    return concatenate([each for each in nearest if each is not None])


def moved(region: Region, observations: Observations, feature_map: FeatureMap) -> Region:
    """A region around the same observations in the space of another feature map."""
    return replace(region, points=np.unique(feature_map(observations), axis=0))
