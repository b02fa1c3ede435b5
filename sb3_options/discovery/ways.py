"""Ways: trajectories without their loops, and the places that they pass."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sb3_options.experience.observations import BoolArray, FloatArray, IntArray

NEAR = 5.0  # a way is near a place within this many radii, and leads through the place within one
AT_ONCE = 1 << 20  # maximum number of distances held at once


def loop_erased(features: FloatArray, visits: IntArray, radius: float) -> IntArray:
    """Return the distinct states of a trajectory without its loops, in order.

    Random walks visit nearly all states, and states that they share by accident pass for bottlenecks. So the way leaves
    each state after the trajectory's last visit to it, and no state comes twice. (Lawler 1980 cuts each loop as it
    closes. Both leave a way from start to end.) A trajectory may end where it began, like a segment between two peaks
    of reward. It does not count as one loop: its last steps, within ``radius`` of its start, are left out.

    States within ``radius`` count as the same, because in continuous spaces no state repeats exactly. ``features`` are
    φ of the distinct states in scaled units, (m, d), and ``visits`` their rows at every time t = 0 … T. Returns rows,
    (k,), each at most once. The first is ``visits[0]``. The last is within ``radius`` of the trajectory's end, or of
    the last state before its return to the start.
    """
    if np.linalg.norm(features[visits[-1]] - features[visits[0]]) <= radius:
        away = np.linalg.norm(features - features[visits[0]], axis=1) > radius
        visits = visits[: max(np.flatnonzero(away[visits]), default=0) + 1]
    last_visit = np.zeros(len(features), dtype=np.int64)  # visits that were left out do not count
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
    """Return a function of a row: when the trajectory was last within a radius of its state."""
    last = last_visit.tolist()
    neighbours = cKDTree(features)
    return lambda row: max(last[near] for near in neighbours.query_ball_point(features[row], radius))


class PassingShare:
    """For each state of many ways, the share of nearby ways that lead through it.

    All ways that come near a doorway pass through it. Most ways that come near a place in open space pass beside it. An
    extra way is assumed to pass beside every place, so that one or two ways show nothing.
    """

    def __init__(self, radius: float) -> None:
        self._limits = np.array([[NEAR * radius], [radius]])
        self._ways: dict[int, FloatArray] = {}  # by id
        self._states: FloatArray = np.zeros((0, 0))  # of all ways, in their order
        self._counts: IntArray = np.zeros((2, 0), dtype=np.int64)  # at each state: ways near, ways through

    def update(self, ways: Sequence[FloatArray]) -> FloatArray:
        """Return the shares among these ways. Only ways added or removed since the last call are counted."""
        current = {id(way): way for way in ways}
        gone = [way for key, way in self._ways.items() if key not in current]
        if gone:
            stays = np.repeat([key in current for key in self._ways], list(map(len, self._ways.values())))
            self._ways = {key: way for key, way in self._ways.items() if key in current}
            self._states, self._counts = self._states[stays], self._counts[:, stays]
            for way in gone if self._ways else ():
                self._counts -= self._leads_by(way)[0]
        for key, way in current.items():
            if key not in self._ways:
                self._add(key, way)
        near, through = self._counts
        shares: FloatArray = through / (near + 1.0)
        if list(self._ways) == list(map(id, ways)):
            return shares
        ends = np.cumsum(list(map(len, self._ways.values())))
        of_way = dict(zip(self._ways, np.split(shares, ends[:-1]), strict=True))
        return np.concatenate([of_way[id(way)] for way in ways])

    def _add(self, key: int, way: FloatArray) -> None:
        """Add a way to the counts of all other ways, and count all ways at its own states."""
        n = len(self._states)
        self._ways[key] = way
        self._states = np.concatenate([self._states, way]) if n else way
        leads, own = self._leads_by(way)
        self._counts = np.concatenate([self._counts + leads[:, :n], own], axis=1)

    def _leads_by(self, way: FloatArray) -> tuple[BoolArray, IntArray]:
        """Return which states a way is near and leads through, (2, n), and how many ways do so at its own, (2, k)."""
        starts = np.cumsum([0, *map(len, self._ways.values())])[:-1]
        at_once = max(AT_ONCE // max(self._states.shape), 1)
        nearest = np.full(len(self._states), np.inf)
        own = np.zeros((2, len(way)), dtype=np.int64)
        for first in range(0, len(way), at_once):
            part = slice(first, first + at_once)
            distances = cdist(way[part], self._states)
            np.minimum(nearest, distances.min(axis=0), out=nearest)
            by_way = np.minimum.reduceat(distances, starts, axis=1)
            own[:, part] = (by_way <= self._limits[..., None]).sum(axis=2)
        return nearest <= self._limits, own
