"""Settings of discovery."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from sb3_options.checked import Field, settings
from sb3_options.density.groups import FeatureGroup
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.recording import LONGEST_EPISODE

MethodName = Literal["diverse-density", "relative-novelty", "random"]
"""Names of the methods of discovery."""


@settings
class DiscoverySettings:
    """How subgoals are found (McGovern & Barto 2001, §4–5). Distances are in scaled units of concept space.

    Attributes:
        method: Name of the method of discovery, one of `methods.METHODS`. Methods other than ``diverse-density`` use
            only the static filter, `spacing`, `subgoal_radius`, `scale`, `capacity`, `max_share` and `segmentation`.
        segmentation: A trajectory is an episode (``episodes``) or, in continuing tasks, a segment between two ``peaks``
            of reward (`recording.SegmentRecorder`).
        max_segment: A segment without a peak fails after this many primitive steps. It should exceed the steps that
            random exploration takes from peak to peak.
        max_share: Maximum share of training that searches may take, None for any. It is counted in work, not by the
            clock (`budget`). After an expensive search the next ones come later. Training counts as at least 40,000
            steps long, so that first searches come early.
        capacity: Number of trajectories kept: the last n.
        min_positive: Number of positive bags before the first search. With few bags, accidents tie with bottlenecks.
        loops: ``erase`` removes loops from a successful trajectory before its states become a bag
            (`ways.loop_erased`). ``keep`` makes a bag of all visited states, as the paper does.
        min_passing: Of the successful ways that come near a state, the share that must pass through it
            (`ways.PassingShare`). Nearly all ways that come near a doorway pass it. Such a state must also cut off its
            surroundings (`local_cuts.LocalCuts`). 0 takes every state.
        salient_share: Before ``min_positive`` successes, a trajectory that meets a rare thing counts as successful up
            to that moment (`salience.Salience`). Rare means: at most this share of trajectories meet it. Only for a φ
            with groups of features. 0 disables it.
        negative_strength: η in [0, 1]: weight of an instance of a negative bag against a concept near it. It is below 1
            because an unsuccessful trajectory may pass a bottleneck (the paper's §8). 0 ignores negative bags.
        leak: λ in [0, 1): probability that a trajectory succeeds without the bottleneck, by another way. Above 0, such
            a trajectory costs a concept at most log λ.
        search: ``gradient`` ascent from many starts, or ``exhaustive`` over the instances of positive bags.
        search_growth: Number of new trajectories before the next search, for each success that is kept. With 0.05 a
            search follows every trajectory until there are twenty successes. With 0 it always does, as in the paper.
        scale: Factor for every feature, 1/width of the Gaussians. None takes `default_scale`.
        start_radius: The default static filter keeps subgoals farther than this from the start of a trajectory. One-hot
            codes have no distances, so there it counts steps along the trajectory.
        goal_radius: The default static filter keeps subgoals farther than this from the end of a trajectory.
        decay: λ of the running averages.
        threshold: Share of the limit λ/(1−λ) that makes a concept persistent.
        subgoal_radius: The subgoal is everything within this distance of the persistent peak.
        spacing: Minimum distance of a new subgoal from those that have an option.
    """

    method: MethodName = "diverse-density"
    segmentation: Literal["episodes", "peaks"] = "episodes"
    max_segment: Annotated[int, Field(ge=1, le=LONGEST_EPISODE)] = 10_000
    max_share: Annotated[float, Field(gt=0, le=1)] | None = 0.05
    capacity: Annotated[int, Field(ge=1)] = 100
    min_positive: Annotated[int, Field(ge=1)] = 4
    loops: Literal["erase", "keep"] = "erase"
    min_passing: Annotated[float, Field(ge=0, lt=1)] = 0.7
    salient_share: Annotated[float, Field(ge=0, lt=1)] = 0.0
    negative_strength: Annotated[float, Field(ge=0, le=1)] = 0.1
    leak: Annotated[float, Field(ge=0, lt=1)] = 0.3
    search: Literal["gradient", "exhaustive"] = "gradient"
    search_growth: Annotated[float, Field(ge=0, lt=1)] = 0.05
    scale: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    start_radius: Annotated[float, Field(ge=0)] = 2.0
    goal_radius: Annotated[float, Field(ge=0)] = 2.0
    decay: Annotated[float, Field(gt=0, lt=1)] = 0.75
    threshold: Annotated[float, Field(ge=0, lt=1)] = 0.6
    subgoal_radius: Annotated[float, Field(ge=0)] = 0.5
    spacing: Annotated[float, Field(ge=0)] = 3.0


CATEGORICAL_SCALE = 6.0
"""With it, one-hot codes of two states are 6√2 = 8.5 units apart, farther than any default radius."""

SHOWN = 6
"""Number of coordinates shown of a point: enough for presence and position of two things."""

UNITS_PER_RANGE = 20.0
"""Unscaled features are assumed to have this many distinguishable values over the range seen so far."""


def described(point: FloatArray, kind: str | None, group: FeatureGroup | None = None) -> str:
    """Describe a point, (d,), or (k,) of a group: the state behind a one-hot code, or the first `SHOWN` coordinates."""
    if group is not None:
        return group.told(point) or f"{group.name} at {described(point, None)}"
    if kind == "categorical":
        return f"state {int(point.argmax())}"
    return ", ".join(f"{x:g}" for x in point[:SHOWN]) + (", …" if len(point) > SHOWN else "")


def default_scale(kind: str | None, features: FloatArray) -> FloatArray:
    """Return the scale, (d,), that makes one unit of concept space one step, as far as all features (m, d) seen tell.

    It is `CATEGORICAL_SCALE`, or `UNITS_PER_RANGE` over the range of each feature, by where φ comes from
    (`features.FeatureKind`). A user's φ and an environment's own are assumed to be in such units already.
    """
    d = features.shape[1]
    if kind == "categorical":
        return np.full(d, CATEGORICAL_SCALE)
    if kind == "identity":
        extent = np.ptp(features, axis=0)
        return UNITS_PER_RANGE / np.where(extent > 0, extent, UNITS_PER_RANGE)
    return np.ones(d)
