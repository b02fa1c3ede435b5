"""How much more often successes than failures visit a state of a feature group."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import filterfalse
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from sb3_options.density.groups import FeatureGroup
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.experience.trajectories import LabelledTrajectory

MIN_CONTRAST = 0.3  # least contrast of an instance
MAX_START_SHARE = 0.5  # a state where more than this share of the trajectories begin is no place to reach
PAIR_GAIN = 0.1  # a state's contrast in a group must exceed its contrast in any part of the group by this much
NO_PLACE = -1.0  # contrast of a state that is not a place of the group; no place has less
ABSENT = -2.0  # contrast of an absent state: none of the current trajectories visited it
MAX_FORMER_STATES = 1000  # absent states are forgotten once they outnumber the present ones by more than this


class Contrast:
    """For each state of a group, the share of successes that visit it minus the share of failures.

    Diverse density asks whether all successes share an instance, and gives failures little weight. On a few features
    all trajectories have much in common, such as a wall ahead. Successes visit the states that matter more often.
    A share of n trajectories is estimated as (visits + 1) / (n + 2), so that a few trajectories show little.

    A failure lasts until the time limit, long enough to visit nearly every state. So its visit at time t is weighted
    by the share of successes that took t steps or more. This compares failures and successes over equal time. Without
    it, states that take time to reach (a key, say) would stand out too little.
    """

    def __init__(self, group: FeatureGroup, radius: float, parts: Sequence[Contrast] = ()) -> None:
        self.group = group
        self.radius = radius
        self.parts = parts
        self._forget()

    def _forget(self) -> None:
        self._numbers: dict[bytes, int] = {}
        self._values: FloatArray = np.full(1, NO_PLACE)  # by number; the last entry is for number -1: no place
        self._visits: dict[LabelledTrajectory, _Visits] = {}

    def update(self, trajectories: Sequence[LabelledTrajectory]) -> None:
        """Count the visits of these trajectories only."""
        if len(self._numbers) > MAX_FORMER_STATES + 2 * self.n_states:
            self._forget()  # most belong to trajectories that are gone
        if new := list(filterfalse(self._visits.__contains__, trajectories)):
            self._visits |= zip(new, _visits_of(new, self.group, self._numbers), strict=True)
        visits = list(map(self._visits.__getitem__, trajectories))
        if len(self._visits) > 2 * len(visits):
            self._visits = dict(zip(trajectories, visits, strict=True))
        _, firsts, of_each, durations, succeeded = zip(*visits, strict=True)
        success = np.array(succeeded)
        first = np.array(firsts)
        states, times = np.ascontiguousarray(np.concatenate(of_each).T)
        of_whom = np.repeat(np.arange(len(success)), list(map(len, of_each)))
        weights = np.ones(len(states))
        if success.any():
            lasted = np.sort(np.array(durations)[success])
            late = np.searchsorted(lasted, np.arange(times.max(initial=0) + 1)) / len(lasted)
            weights = np.where(success[of_whom], 1.0, 1.0 - late[times])
        began = np.flatnonzero(first >= 0)
        present = np.bincount(states) > 0  # up to the highest present number
        near = self._neighbours(present)
        reached = _reached(states, of_whom, weights, success, near)
        begun = _reached(first[began], began, np.ones(len(began)), success, near)
        shares = (reached + 1.0) / (np.bincount(success, minlength=2)[:, None] + 2.0)
        values = shares[1] - shares[0]
        values[begun.sum(axis=0) / len(success) > MAX_START_SHARE] = NO_PLACE
        values[~present] = ABSENT
        self._values = np.append(values, NO_PLACE)

    def _neighbours(self, present: BoolArray) -> list[IntArray]:
        """Return for each state the numbers of all states within the radius, itself included; none if absent."""
        near: list[IntArray] = [np.zeros(0, dtype=np.int64)] * len(present)
        numbers = np.flatnonzero(present)
        if len(numbers):
            states = np.frombuffer(b"".join(self._numbers)).reshape(-1, len(self.group.features))
            scaled = states[numbers] * np.asarray(self.group.scale)
            for number, these in zip(numbers, cKDTree(scaled).query_ball_point(scaled, self.radius), strict=True):
                near[number] = numbers[these]
        return near

    @property
    def n_states(self) -> int:
        """Number of distinct states of the group in the trajectories."""
        return int((self._values > ABSENT).sum()) - 1

    def largest(self) -> float:
        """Return the largest contrast of all states, ``NO_PLACE`` without any."""
        return float(self._values.max())

    def of_visited(self, labelled: LabelledTrajectory) -> FloatArray:
        """Return the contrast of the states, (m,), of a trajectory in the last update."""
        values: FloatArray = self._values[self._visits[labelled].numbers]
        return values

    def stands_out(self, labelled: LabelledTrajectory) -> BoolArray:
        """Which states, (m,), have ``MIN_CONTRAST``, and ``PAIR_GAIN`` more than in each part of the group."""
        values = self.of_visited(labelled)
        enough: BoolArray = values >= MIN_CONTRAST
        for part in self.parts if enough.any() else ():
            enough &= values >= part.of_visited(labelled) + PAIR_GAIN
        return enough


def _reached(
    states: IntArray, of_whom: IntArray, weights: FloatArray, success: BoolArray, near: Sequence[IntArray]
) -> FloatArray:
    """Count the failures and the successes that visited each state, (2, n).

    A trajectory counts once per state, by its visit of most weight to the state or a neighbour.
    """
    cells = states + len(near) * success[of_whom]
    totals: FloatArray = np.bincount(cells, weights, 2 * len(near)).astype(np.float64).reshape(2, -1)
    if not (crowded := [state for state, others in enumerate(near) if len(others) > 1]):
        return totals
    order = np.argsort(states, kind="stable")
    starts = np.searchsorted(states[order], np.arange(len(near) + 1))
    for state in crowded:
        visits = np.concatenate([order[starts[other] : starts[other + 1]] for other in near[state]])
        most = np.zeros(len(success))
        np.maximum.at(most, of_whom[visits], weights[visits])
        totals[:, state] = most[~success].sum(), most[success].sum()
    return totals


class _Visits(NamedTuple):
    """The visits of a trajectory."""

    numbers: IntArray  # of its states, (m,); -1 for a state that is not a place
    first: int  # number of the first state
    places: IntArray  # distinct numbers of places, and the time of the first visit to each, (k, 2)
    duration: int  # steps
    success: bool


def _visits_of(
    trajectories: Sequence[LabelledTrajectory], group: FeatureGroup, numbers: dict[bytes, int]
) -> Iterator[_Visits]:
    """Return the visits of each trajectory, in one pass: after a pause there may be a thousand new ones."""
    features = np.concatenate([t.features for t in trajectories])
    came = np.concatenate([t.trajectory.arrivals for t in trajectories])
    ends = np.cumsum([len(t.features) for t in trajectories]).tolist()
    places = np.flatnonzero(group.is_place(features))
    own = group.own(features[places]) + 0.0  # -0.0 and 0.0 are one state
    keys = own.view(f"V{own.itemsize * own.shape[1]}").ravel().tolist()
    every = np.full(len(features), -1)
    every[places] = [numbers.setdefault(key, len(numbers)) for key in keys]
    of_whom = np.searchsorted(ends, places, side="right")
    pairs, first = np.unique(of_whom * len(numbers) + every[places], return_index=True)  # states are in time order
    whose, states = np.divmod(pairs, len(numbers))
    visited = np.stack([states, came[places[first]]], axis=1)
    bounds = np.searchsorted(whose, np.arange(len(ends) + 1)).tolist()
    for t, start, end, low, high in zip(trajectories, [0, *ends], ends, bounds, bounds[1:], strict=False):
        yield _Visits(every[start:end], int(every[start]), visited[low:high], len(t.trajectory), t.success)
