"""Ways: trajectories without their loops, and the places that they pass."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sb3_options.density.arrays import row_keys
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray

NEAR = 5.0
"""A way comes near a place within this many times the radius within which it leads through it."""

AT_ONCE = 1 << 20
"""Distances, or features, that are held at once."""

FEW_STATES = 256
"""Up to so many states all distances between them at once take less time than a tree."""


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
    last_visit = np.full(len(features), -1)
    last_visit[visits] = np.arange(len(visits))
    row_at, last_near = visits.tolist(), _last_near(features, last_visit, radius)
    way, time = [], 0
    while time < len(row_at):
        row = row_at[time]
        way.append(row)
        time = 1 + last_near(row)
    return np.array(way, dtype=np.int64)


def _last_near(features: FloatArray, last_visit: IntArray, radius: float) -> Callable[[int], int]:
    """When a trajectory was last within a radius of the state of a row."""
    if len(features) <= FEW_STATES:
        same = cdist(features, features, "sqeuclidean") <= radius**2
        last_nears: list[int] = np.where(same, last_visit, -1).max(axis=1).tolist()
        return last_nears.__getitem__
    last, neighbours = last_visit.tolist(), cKDTree(features)
    return lambda row: max(last[near] for near in neighbours.query_ball_point(features[row], radius))


class PassingShare:
    """Of the ways that come near a state, the share that lead through it, for the states of many ways.

    All ways that come near a doorway pass it. Of the ways that come near a place in open space most pass beside it. One
    way more is taken to pass beside every place, so that one or two ways show nothing.
    """

    def __init__(self, radius: float) -> None:
        self._limits = np.array([[NEAR * radius], [radius]])
        self._ways: dict[int, tuple[FloatArray, IntArray]] = {}  # by id: each way, and the numbers of its states
        self._number: dict[bytes, int] = {}
        self._states: FloatArray = np.zeros((0, 0))
        self._counts: IntArray = np.zeros((2, 0), dtype=np.int64)  # by number: ways near, ways through

    def update(self, ways: Sequence[FloatArray]) -> FloatArray:
        """The shares among these ways; only ways added or removed since the last call are counted."""
        current = set(map(id, ways))
        for gone in [key for key in self._ways if key not in current]:
            self._remove(gone)
        new = [way for way in ways if id(way) not in self._ways]
        if new:
            self._add(new)
        near, through = self._counts[:, np.concatenate([self._ways[id(way)][1] for way in ways])]
        shares: FloatArray = through / (near + 1.0)
        return shares

    def _add(self, ways: Sequence[FloatArray]) -> None:
        """Count ways at all states, and the ways before them at those of their states that are new."""
        n_known, together = len(self._number), np.concatenate(ways)
        numbers = np.array([self._number.setdefault(key, len(self._number)) for key in row_keys(together)])
        if len(self._number) > n_known:
            new = np.unique(numbers[numbers >= n_known], return_index=True)[1]
            states = together[numbers >= n_known][new]
            self._states = np.concatenate([self._states.reshape(-1, together.shape[1]), states])
            self._counts = np.concatenate([self._counts, self._led_by_others(states, n_known)], axis=1)
        starts = np.cumsum([0, *map(len, ways[:-1])])
        own = np.split(numbers, starts[1:])
        self._ways |= {id(way): (way, of) for way, of in zip(ways, own, strict=True)}
        for of in own:
            self._counts += self._leads_by(of)

    def _led_by_others(self, states: FloatArray, n_known: int) -> IntArray:
        """How many of the ways before come near new states, and lead through them, (2, n)."""
        counts = np.zeros((2, len(states)), dtype=np.int64)
        if self._ways:
            of_others = [of for _, of in self._ways.values()]
            starts, others = np.cumsum([0, *map(len, of_others[:-1])]), np.concatenate(of_others)
            for rows in self._in_parts(np.arange(len(states)), len(others)):
                distances = cdist(states[rows], self._states[:n_known])[:, others]
                nearest = np.minimum.reduceat(distances, starts, axis=1)
                counts[:, rows] = (nearest <= self._limits[..., None]).sum(axis=2)
        return counts

    def _remove(self, key: int) -> None:
        """Take a way out of the counts, and forget states that no way has, if they are most."""
        _, numbers = self._ways.pop(key)
        self._counts -= self._leads_by(numbers)
        if 2 * sum(len(of) for _, of in self._ways.values()) < len(self._number):
            used = np.unique(np.concatenate([numbers[:0], *(of for _, of in self._ways.values())]))
            place = np.full(len(self._number), -1)
            place[used] = np.arange(len(used))
            keys = list(self._number)
            self._number = {keys[number]: i for i, number in enumerate(used.tolist())}
            self._states, self._counts = self._states[used], self._counts[:, used]
            self._ways = {key: (way, place[of]) for key, (way, of) in self._ways.items()}

    def _leads_by(self, numbers: IntArray) -> BoolArray:
        """Which states a way comes near and leads through, (2, n)."""
        nearest: FloatArray = np.full(len(self._states), np.inf)
        for rows in self._in_parts(numbers, len(self._states)):
            np.minimum(nearest, cdist(self._states[rows], self._states).min(axis=0), out=nearest)
        leads: BoolArray = nearest <= self._limits
        return leads

    def _in_parts(self, numbers: IntArray, n_compared: int) -> Iterator[IntArray]:
        """These, as many at once as memory should hold distances to others, and copies of them."""
        size = max(AT_ONCE // max(n_compared, self._states.shape[1]), 1)
        return (numbers[start : start + size] for start in range(0, len(numbers), size))
