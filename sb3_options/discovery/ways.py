"""The ways of trajectories: what is left of them when every loop is cut out, and which places they lead through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sb3_options.experience.observations import FloatArray, IntArray

NEAR = 5.0
"""A way comes near a place within this many times the radius within which it leads through it."""


def loop_erased(features: FloatArray, visits: IntArray, radius: float) -> IntArray:
    """The distinct states of a trajectory without its loops, in order.

    A random walk visits nearly everything, and what all walks have in common by accident passes for a bottleneck. From
    each state the way goes on after the last time the trajectory was there, so that no state comes twice (Lawler 1980
    cuts each loop as it closes; both leave a way from start to end). A trajectory that ends where it began, as segments
    between two peaks of reward do, is no loop as a whole: its last step is left out.

    Args:
        features: φ of the distinct states in scaled units, shape (m, d).
        visits: Row of ``features`` at every time t = 0 … T, shape (T + 1,).
        radius: States within this distance count as the same, ≥ 0. In continuous spaces no state repeats exactly.

    Returns:
        Rows of ``features``, shape (k,), k ≤ m, each at most once. The first is ``visits[0]``; the last is within
        ``radius`` of where the trajectory ended.
    """
    if np.linalg.norm(features[visits[-1]] - features[visits[0]]) <= radius:
        visits = visits[: max(len(visits) - 1, 1)]
    last_visit = np.zeros(len(features), dtype=np.int64)
    last_visit[visits] = np.arange(len(visits))
    neighbours = cKDTree(features)
    way, time = [], 0
    while time < len(visits):
        row = int(visits[time])
        way.append(row)
        same = neighbours.query_ball_point(features[row], radius)
        time = 1 + int(last_visit[same].max())
    return np.array(way, dtype=np.int64)


class PassingShare:
    """Of the ways that come near a state, the share that lead through it, for the states of many ways.

    All ways that come near a doorway pass it. Of the ways that come near a place in open space most pass beside it. One
    way more is taken to pass beside every place, so that one or two ways show nothing.

    Args:
        radius: In scaled units. A way leads through a place within this distance, and comes near it within `NEAR` times
            as much.
    """

    def __init__(self, radius: float) -> None:
        self._radius = radius
        self._counts: dict[int, tuple[FloatArray, IntArray]] = {}  # the way, and (2, k): near, through

    def update(self, ways: Sequence[FloatArray]) -> list[FloatArray]:
        """The shares among these ways; only what is new or gone since the last call is counted.

        Args:
            ways: Each in scaled units, shape (k_i, d), k_i ≥ 1. A way is known again by being the same array.

        Returns:
            For each way those of its states, shape (k_i,), in [0, 1).
        """
        self._counts = {id(way): (way, counts) for way, counts in self._counts.values()}  # a copy has another id
        current = {id(way) for way in ways}
        for key in [key for key in self._counts if key not in current]:
            way, _ = self._counts.pop(key)
            self._count(way, -1)
        for way in ways:
            if id(way) not in self._counts:
                itself = np.ones((2, len(way)), dtype=np.int64)
                self._counts[id(way)] = way, itself + self._count(way, 1)
        counts = [self._counts[id(way)][1] for way in ways]
        return [through / (near + 1.0) for near, through in counts]

    def _count(self, way: FloatArray, sign: int) -> IntArray:
        """Count a way at the states of all others, and return the counts of these at its own, (2, k)."""
        limits = np.array([NEAR * self._radius, self._radius])[:, None]
        own = np.zeros((2, len(way)), dtype=np.int64)
        for other, counts in self._counts.values():
            distances = cdist(way, other)
            counts += sign * (distances.min(axis=0) <= limits)
            own += distances.min(axis=1) <= limits
        return own
