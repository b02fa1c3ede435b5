"""The ways of trajectories: what is left of them when every loop is cut out, and which places they lead through."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sb3_options.experience.observations import FloatArray, IntArray

NEAR = 5.0
"""A way comes near a place within this many times the radius within which it leads through it."""

AT_ONCE = 1 << 20
"""Distances, or features, that are held at once."""


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
    last, row_at, neighbours = last_visit.tolist(), visits.tolist(), cKDTree(features)
    way, time = [], 0
    while time < len(row_at):
        row = row_at[time]
        way.append(row)
        time = 1 + max(last[same] for same in neighbours.query_ball_point(features[row], radius))
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
        self._limits = np.array([NEAR * radius, radius])
        self._ways: list[FloatArray] = []
        self._counts: IntArray = np.zeros((2, 0), dtype=np.int64)  # near and through, way after way

    def update(self, ways: Sequence[FloatArray]) -> FloatArray:
        """The shares among these ways; only what is new or gone since the last call is counted.

        Args:
            ways: Each in scaled units, shape (k_i, d), k_i ≥ 1, none of them twice. A way is known again by being the
                same array.

        Returns:
            Those of their states, way after way, shape (Σ k_i,), in [0, 1).
        """
        current = set(map(id, ways))
        for i in reversed([i for i, way in enumerate(self._ways) if id(way) not in current]):
            start, way = sum(map(len, self._ways[:i])), self._ways.pop(i)
            self._counts = np.delete(self._counts, slice(start, start + len(way)), axis=1)
            self._count(way, -1)
        known = set(map(id, self._ways))
        for way in ways:
            if id(way) not in known:
                own = 1 + self._count(way, 1)
                self._ways.append(way)
                self._counts = np.concatenate([self._counts, own], axis=1)
        near, through = self._counts
        shares: FloatArray = through / (near + 1.0)
        if list(map(id, self._ways)) == list(map(id, ways)):  # new ways come last
            return shares
        parts = np.split(shares, np.cumsum([len(way) for way in self._ways])[:-1])
        part_of = dict(zip(map(id, self._ways), parts, strict=True))
        return np.concatenate([part_of[id(way)] for way in ways])

    def _count(self, way: FloatArray, sign: int) -> IntArray:
        """Count a way at the states of all others, and return the counts of these at its own, (2, k)."""
        limits, own, end = self._limits[:, None], np.zeros((2, len(way)), dtype=np.int64), 0
        for others in self._in_parts(way):
            starts = np.cumsum([0, *map(len, others[:-1])])
            distances = cdist(way, np.concatenate(others))
            start, end = end, end + distances.shape[1]
            self._counts[:, start:end] += sign * (distances.min(axis=0) <= limits)
            nearest = np.minimum.reduceat(distances, starts, axis=1)
            own += (nearest <= limits[..., None]).sum(axis=2)
        return own

    def _in_parts(self, way: FloatArray) -> Iterator[list[FloatArray]]:
        """The other ways, as many at once as memory should hold distances to them, and copies of them."""
        part, size = list[FloatArray](), 0
        for other in self._ways:
            if part and size + len(other) > AT_ONCE // max(way.shape):
                yield part
                part, size = [], 0
            part.append(other)
            size += len(other)
        if part:
            yield part
