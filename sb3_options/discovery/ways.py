"""Ways: trajectories without their loops, and the places that they pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sb3_options.experience.observations import FloatArray, IntArray

NEAR = 5.0
"""A way comes near a place within this many times the radius within which it leads through it."""

AT_ONCE = 1 << 20
"""Distances that are held at once."""


def loop_erased(features: FloatArray, visits: IntArray, radius: float) -> IntArray:
    """The distinct states of a trajectory without its loops, in order.

    A random walk visits nearly everything, and what all walks have in common by accident passes for a bottleneck. From
    each state the way goes on after the last time the trajectory was there, so that no state comes twice (Lawler 1980
    cuts each loop as it closes; both leave a way from start to end). A trajectory that ends where it began, as segments
    between two peaks of reward do, is no loop as a whole: its last steps, within ``radius`` of its start, are left out.

    Args:
        features: φ of the distinct states in scaled units, shape (m, d).
        visits: Row of ``features`` at every time t = 0 … T, shape (T + 1,).
        radius: States within this distance count as the same, ≥ 0. In continuous spaces no state repeats exactly.

    Returns:
        Rows of ``features``, shape (k,), k ≤ m, each at most once. The first is ``visits[0]``; the last is within
        ``radius`` of where the trajectory ended, or, where that is within ``radius`` of its start, of the last state
        before it came back.
    """
    if np.linalg.norm(features[visits[-1]] - features[visits[0]]) <= radius:
        away = np.linalg.norm(features - features[visits[0]], axis=1) > radius
        visits = visits[: max(np.flatnonzero(away[visits]), default=0) + 1]
    last_visit = np.zeros(len(features), dtype=np.int64)  # of what was left out no visit counts
    last_visit[visits] = np.arange(len(visits))
    row_at = visits.tolist()
    last_near = _last_near(features, last_visit, radius)
    way, time = [], 0
    while time < len(row_at):
        row = row_at[time]
        way.append(row)
        time = 1 + last_near(row)
    return np.array(way, dtype=np.int64)


def _last_near(features: FloatArray, last_visit: IntArray, radius: float) -> Callable[[int], int]:
    """When a trajectory was last within a radius of the state of a row."""
    last = last_visit.tolist()
    neighbours = cKDTree(features)
    return lambda row: max(last[near] for near in neighbours.query_ball_point(features[row], radius))


class PassingShare:
    """Of the ways that come near a state, the share that lead through it, for the states of many ways.

    All ways that come near a doorway pass it. Of the ways that come near a place in open space most pass beside it. One
    way more is taken to pass beside every place, so that one or two ways show nothing.
    """

    def __init__(self, radius: float) -> None:
        self._limits = np.array([[NEAR * radius], [radius]])
        self._ways: dict[int, FloatArray] = {}  # by id
        self._counts: dict[int, IntArray] = {}  # of each way, at its states: ways near, ways through, (2, k)

    def update(self, ways: Sequence[FloatArray]) -> FloatArray:
        """The shares among these ways; only ways added or removed since the last call are counted."""
        current = set(map(id, ways))
        for key in [key for key in self._ways if key not in current]:
            gone = self._ways.pop(key)
            del self._counts[key]
            if self._ways:
                self._count(gone, -1)
        for way in ways:
            if id(way) not in self._ways:
                self._ways[id(way)] = way
                self._count(way, 1)
        near, through = np.concatenate([self._counts[id(way)] for way in ways], axis=1)
        shares: FloatArray = through / (near + 1.0)
        return shares

    def _count(self, way: FloatArray, sign: int) -> None:
        """Add a way to the counts at the states of all others, and all to the counts at its own; or take it out."""
        together = np.concatenate(list(self._ways.values()))
        starts = np.cumsum([0, *map(len, self._ways.values())])[:-1]
        at_once = max(AT_ONCE // max(together.shape), 1)
        nearest = np.full(len(together), np.inf)
        own = np.zeros((2, len(way)), dtype=np.int64)
        for first in range(0, len(way), at_once):
            part = slice(first, first + at_once)
            distances = cdist(way[part], together)
            np.minimum(nearest, distances.min(axis=0), out=nearest)
            by_way = np.minimum.reduceat(distances, starts, axis=1)
            own[:, part] = (by_way <= self._limits[..., None]).sum(axis=2)
        leads = np.split(nearest <= self._limits, starts[1:], axis=1)
        for key, at_its_states in zip(self._ways, leads, strict=True):
            self._counts[key] = own if self._ways[key] is way else self._counts[key] + sign * at_its_states
