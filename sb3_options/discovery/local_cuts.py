"""Which states cut off their neighbourhood, in the graph of visited states."""

from __future__ import annotations

import numpy as np

from sb3_options.density.arrays import row_keys, short_key
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray

STEPS = 3
"""The surroundings of a state are what lies within so many steps of it."""

MAX_STATES = 10_000
"""As many are in the graph; of states that come later nothing is known."""

MIN_CUT = 0.1
"""Least share of its surroundings that an instance cuts off: a doorway a third or more, a piece of floor nothing."""

UNKNOWN = 0.5
"""The share of a state of which nothing is known: as far as anybody knows it parts its surroundings in two."""


class LocalCuts:
    """What share of its surroundings a state cuts off from the rest.

    Where an agent has learned a way, its successes share that way from end to end: the floor before a doorway lies on
    as many of them as the doorway itself. What tells the two apart is what else was visited around them, in success or
    failure. Without the doorway, the states around it fall apart; around a piece of floor other steps lead on. Such a
    state is a cut vertex of the graph of its surroundings, the graph that Şimşek & Barto (2008) rank by betweenness.

    Two states are joined if a step led from one to the other, in either direction. A state that only one trajectory
    visited counts as a cut, so that nothing is said where no state is visited twice, as in continuous spaces.

    Attributes:
        n_computed: Shares that were computed; the others were known.
    """

    STATE = ("n_computed", "_number", "_neighbours", "_n_trajectories", "_shares")

    def __init__(self) -> None:
        self.n_computed = 0
        self._number: dict[bytes, int] = {}
        self._neighbours: list[set[int]] = []
        # By number, and at last for states that have none.
        self._n_trajectories: IntArray = np.zeros(MAX_STATES + 1, dtype=np.int64)
        self._shares: FloatArray = np.full(MAX_STATES + 1, np.nan)  # NaN where it has to be computed
        self._shares[-1] = UNKNOWN

    def add(self, features: FloatArray, visits: IntArray) -> None:
        """Add the steps of a trajectory."""
        known = self._number
        numbers = np.array([known[key] if key in known else self._numbered(key) for key in keys_of(features)])
        self._n_trajectories[numbers] += 1  # by one, however often a number is among these
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
        """The numbers of some states, (n,); −1 for those that have none."""
        return np.array([self._number.get(key, -1) for key in keys_of(features)], dtype=np.int64)

    def are_known(self, features: FloatArray) -> BoolArray:
        """Whether more than one trajectory visited each of some states (n, d), so that its share says something."""
        numbers = self._numbers(features)
        known: BoolArray = (numbers >= 0) & (self._n_trajectories[numbers] > 1)
        return known

    def shares(self, features: FloatArray) -> FloatArray:
        """What share of its surroundings each of some states (n, d) cuts off from their largest part, in [0, 0.5]."""
        numbers = self._numbers(features)
        once = self._n_trajectories[numbers] == 1
        for number in set(numbers[np.isnan(self._shares[numbers]) & ~once].tolist()):
            self._shares[number] = self._computed(number)
        return np.where(once, UNKNOWN, self._shares[numbers])

    def _numbered(self, key: bytes) -> int:
        """The number of a new state, −1 if there is no room."""
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
    """A key for each state (n, d), which equal ones share."""
    return list(map(short_key, row_keys(features)))
