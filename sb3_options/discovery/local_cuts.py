"""Which states cut off their neighbourhood, in the graph of visited states."""

import numpy as np

from sb3_options.density.arrays import row_keys, short_key
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray

STEPS = 3  # the surroundings of a state are the states within this many steps
MAX_STATES = 10_000  # in the graph; later states stay unknown
MIN_CUT = 0.1  # least share of its surroundings that an instance cuts off; a doorway cuts off a third, open floor none
UNKNOWN = 0.5  # share of an unknown state: it is assumed to split its surroundings in two


class LocalCuts:
    """Computes the share of its surroundings that each state cuts off from the rest.

    Once an agent has learned a path, its successes share that path from end to end. The floor before a doorway then
    lies on as many of them as the doorway. All visits nearby, in success or failure, tell the two apart. Without the
    doorway its surroundings fall apart; around a piece of floor other steps lead on. A doorway is thus a cut vertex of
    the graph of its surroundings. Şimşek & Barto (2008) rank this graph by betweenness.

    Two states are joined if a step led from one to the other, in either direction. A state visited by only one
    trajectory counts as a cut. So the filter has no effect where no state repeats, as in continuous spaces.
    """

    STATE = ("n_computed", "_number", "_neighbours", "_n_trajectories", "_shares")

    def __init__(self) -> None:
        self.n_computed = 0  # shares that were computed rather than looked up
        self._number: dict[bytes, int] = {}
        self._neighbours: list[set[int]] = []
        # By number; the last entry is for states without a number.
        self._n_trajectories: IntArray = np.zeros(MAX_STATES + 1, dtype=np.int64)
        self._shares: FloatArray = np.full(MAX_STATES + 1, np.nan)  # NaN if it must be computed
        self._shares[-1] = UNKNOWN

    def add(self, features: FloatArray, visits: IntArray) -> None:
        """Add the steps of a trajectory."""
        known = self._number
        numbers = np.array([known[key] if key in known else self._numbered(key) for key in keys_of(features)])
        self._n_trajectories[numbers] += 1  # by one, even if a number occurs repeatedly
        way = numbers[visits]
        steps = set(zip(way[:-1].tolist(), way[1:].tolist(), strict=True))
        near = self._neighbours
        new = [(a, b) for a, b in steps if a != b and min(a, b) >= 0 and b not in near[a]]
        if new:
            for one, other in new:
                near[one].add(other)
                near[other].add(one)
            self._shares[list(self._around({number for step in new for number in step}))] = np.nan

    def _numbers(self, features: FloatArray) -> IntArray:
        """Return the numbers of states, (n,); −1 for a state without one."""
        return np.array([self._number.get(key, -1) for key in keys_of(features)], dtype=np.int64)

    def are_known(self, features: FloatArray) -> BoolArray:
        """Whether more than one trajectory visited each state (n, d): only then its share has meaning."""
        numbers = self._numbers(features)
        known: BoolArray = (numbers >= 0) & (self._n_trajectories[numbers] > 1)
        return known

    def shares(self, features: FloatArray) -> FloatArray:
        """Return the share of its surroundings that each state (n, d) cuts off from the largest part, in [0, 0.5]."""
        numbers = self._numbers(features)
        once = self._n_trajectories[numbers] == 1
        for number in set(numbers[np.isnan(self._shares[numbers]) & ~once].tolist()):
            self._shares[number] = self._computed(number)
        return np.where(once, UNKNOWN, self._shares[numbers])

    def _numbered(self, key: bytes) -> int:
        """Number a new state; return −1 if there is no room."""
        if len(self._number) >= MAX_STATES:
            return -1
        self._neighbours.append(set())
        self._number[key] = number = len(self._number)
        return number

    def _computed(self, number: int) -> float:
        self.n_computed += 1
        left = self._around({number}) - {number}
        n = len(left)
        largest = 0
        while left:
            border = [left.pop()]
            size = 1
            while border:
                found = self._neighbours[border.pop()] & left
                left -= found
                border.extend(found)
                size += len(found)
            largest = max(largest, size)
        return min((n - largest) / n, 0.5) if n else 0.0

    def _around(self, numbers: set[int]) -> set[int]:
        around = border = numbers
        for _ in range(STEPS):
            border = set().union(*(self._neighbours[each] for each in border)) - around
            around = around | border
        return around


def keys_of(features: FloatArray) -> list[bytes]:
    """Return a key for each state (n, d); equal states share a key."""
    return list(map(short_key, row_keys(features)))
