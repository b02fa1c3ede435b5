"""Regions of concept space: unions of balls, and half-spaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np

from sb3_options.density.arrays import BoolArray, FloatArray
from sb3_options.density.groups import FeatureGroup
from sb3_options.state import storable

MOST = 2.0**40  # whole numbers below this one keep their distance when they are scaled, in spite of rounding


@cache
def _cdist() -> Callable[[FloatArray, FloatArray], FloatArray]:
    from scipy.spatial.distance import cdist  # here, because it takes a third of a second to import

    return cdist


@storable
@dataclass(frozen=True)
class Region:
    """A union of balls of one radius in concept space: a subgoal (one ball) or an initiation set (many).

    Attributes:
        points: Centres, shape (n, d), or (n, k) in the group's own features.
        scale: Factor for every feature before distances are taken, shape (d,) or (k,).
        radius: Radius of the balls in scaled units, ≥ 0.
        group: The features that count, if not all do.
        normal: Normal of a half-space, (d,), where normal · (feature − point) ≥ 0 for the one point.
    """

    points: FloatArray
    scale: FloatArray
    radius: float
    group: FeatureGroup | None = field(default=None, kw_only=True)
    normal: FloatArray | None = field(default=None, kw_only=True)

    def contains(self, features: FloatArray) -> BoolArray:
        """Whether min over centres of ‖scale · (feature − centre)‖ ≤ radius, for features (batch, d), shape (batch,).

        With a group, only places of the group are in the region.
        """
        if len(features) == 1:
            return np.array([self.contains_one(features[0].tolist())])
        if self.group is None:
            return self.covers(features)
        places = self.group.is_place(features)
        return places & self.covers(self.own(features)) if places.any() else places

    def contains_one(self, features: list[float]) -> bool:
        """`contains` for one row of features, in every step of an agent: numpy calls would cost more than the rest."""
        if self.group is None:
            return self._covers_one(features)
        return self.group.holds(features) and self._covers_one(self.group.own_of_one(features))

    def covers(self, points: FloatArray) -> BoolArray:
        """`contains` for places given only by the features that count, (batch, d) or (batch, k)."""
        if self.normal is not None:
            return np.asarray((points - self.points[0]) @ self.normal >= 0)
        if len(self.points) == 0:
            return np.zeros(len(points), dtype=bool)
        nearest: FloatArray = _cdist()(points * self.scale, self._scaled).min(axis=1)
        return nearest <= self.radius

    def _covers_one(self, point: list[float]) -> bool:
        if self.normal is not None:
            return bool(self.covers(np.array([point]))[0])
        if len(self.points) == 0:
            return False
        scaled = tuple([x * factor for x, factor in zip(point, self._factors, strict=True)])
        if scaled in self._centres:
            return True
        if self._apart and all(x % 1 == 0 for x in point):
            return False
        if len(self._centres) != 1:
            return bool(self.covers(np.array([point]))[0])
        (centre,) = self._centres
        square = 0.0  # term by term, as `cdist` adds them: `math.dist` and `sum` round differently
        for x, other in zip(scaled, centre, strict=True):
            square += (x - other) * (x - other)
        return math.sqrt(square) <= self.radius

    @cached_property
    def _scaled(self) -> FloatArray:
        return self.points * self.scale

    @cached_property
    def _centres(self) -> frozenset[tuple[float, ...]]:
        return frozenset(map(tuple, self._scaled.tolist()))

    @cached_property
    def _apart(self) -> bool:
        """Whether the centres are whole numbers, and other whole numbers farther from them than the radius."""
        whole = np.array_equal(self.points, np.round(self.points)) and bool(np.abs(self.points).max() < MOST)
        return whole and self.radius < 0.999 * min(self._factors)

    @cached_property
    def _factors(self) -> list[float]:
        return list(np.broadcast_to(self.scale, self.points.shape[1:]).tolist())

    def around(self, points: FloatArray) -> Region:
        """Return the same region around other points, as when φ has moved."""
        return replace(self, points=np.unique(points, axis=0))

    def own(self, features: FloatArray) -> FloatArray:
        """Return the features that count, from all features (batch, d)."""
        return features if self.group is None else self.group.own(features)
