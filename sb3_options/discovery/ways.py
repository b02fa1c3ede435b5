"""Ways: trajectories without their loops, and the places that they pass."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sb3_options.experience.observations import FloatArray, IntArray

NEAR = 5.0
"""A way is near a place within this many radii. It leads through the place within one radius."""

AT_ONCE = 1 << 20
"""Maximum number of distances held at once."""


def loop_erased(features: FloatArray, visits: IntArray, radius: float) -> IntArray:
    """Return the distinct states of a trajectory without its loops, in order.

    Random walks visit nearly all states, and states that they share by accident pass for bottlenecks. So the way leaves
    each state after the trajectory's last visit to it, and no state comes twice. (Lawler 1980 cuts each loop as it
    closes. Both leave a way from start to end.) A trajectory may end where it began, like a segment between two peaks
    of reward. It does not count as one loop: its last steps, within ``radius`` of its start, are left out.

    Args:
        features: φ of the distinct states in scaled units, shape (m, d).
        visits: Row of ``features`` at every time t = 0 … T, shape (T + 1,).
        radius: States within this distance count as the same, ≥ 0. In continuous spaces no state repeats exactly.

    Returns:
        Rows of ``features``, shape (k,), k ≤ m, each at most once. The first is ``visits[0]``. The last is within
        ``radius`` of the trajectory's end. If the end is within ``radius`` of the start, it is within ``radius`` of the
        last state before the return.
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
        self._counts: dict[int, IntArray] = {}  # at the states of each way: ways near, ways through, (2, k)

    def update(self, ways: Sequence[FloatArray]) -> FloatArray:
        """Return the shares among these ways. Only ways added or removed since the last call are counted."""
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
        """Add a way to the counts of all other ways and count all ways at its own states; or remove it."""
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
