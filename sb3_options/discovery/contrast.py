"""How much oftener successful trajectories visit a state of a group of features than unsuccessful ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.density.groups import FeatureGroup
from sb3_options.experience.observations import BoolArray, FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory

MAX_START_SHARE = 0.5
"""A state in which more than this share of the trajectories begin is nothing to reach."""

PAIR_GAIN = 0.1
"""A state of a group must contrast this much more than the same state in a part of the group."""

NO_PLACE = -1.0
"""Contrast of a state that is no place of the group; no place has less."""


class Contrast:
    """Shares of trajectories that visit each state of a group, successful ones minus the others.

    Diverse density asks whether all successful trajectories have an instance in common, and counts unsuccessful ones
    weakly. On a few features much is common to all trajectories: a wall ahead, say. What matters for success is visited
    oftener by those that succeed. A share of n trajectories is taken as (visits + 1) / (n + 2), so that a few of them
    show little.

    An unsuccessful trajectory lasts until the time is up, and in so much time it comes nearly everywhere. So a visit at
    time t counts for as much as the share of the successes that took t steps or more: of what it did, it counts what it
    did in the time that a success has. Without this, what takes time to reach stands out too little (a key, say).

    Args:
        group: The features that count.
        radius: A state is visited within this distance, in scaled units.
        parts: Of groups whose features are some of this one's.
        equal_time: Whether visits of unsuccessful trajectories count by when they were; otherwise all count 1.
    """

    def __init__(
        self, group: FeatureGroup, radius: float, parts: Sequence[Contrast] = (), *, equal_time: bool = True
    ) -> None:
        self.group, self.radius, self.parts, self.equal_time = group, radius, parts, equal_time
        self._values: dict[bytes, float] = {}
        self._visits: dict[int, _Visits] = {}

    def update(self, trajectories: Sequence[LabelledTrajectory]) -> None:
        """Count the visits of these trajectories, and of no others."""
        old = {id(visits.labelled): visits for visits in self._visits.values()}  # a copied object has another id
        self._visits = {id(t): old.get(id(t)) or _Visits(t, self.group) for t in trajectories}
        visits = [self._visits[id(t)] for t in trajectories]
        states, which = np.unique(np.concatenate([v.states for v in visits]), axis=0, return_inverse=True)
        success = np.array([t.success for t in trajectories], dtype=bool)
        durations = np.sort([len(t.trajectory) for t in trajectories if t.success])
        n_states = np.array([len(v.states) for v in visits])
        rows, columns = np.repeat(np.arange(len(visits)), n_states), which.ravel()
        counts = np.ones(len(rows))
        if self.equal_time and len(durations):
            times = np.concatenate([v.times for v in visits])
            counts = np.where(success[rows], 1.0, 1.0 - np.searchsorted(durations, times) / len(durations))
        reached, began = np.zeros((2, len(visits), len(states)))
        reached[rows, columns] = counts
        starts = np.cumsum(n_states) - n_states
        firsts = [(i, int(starts[i]) + v.first) for i, v in enumerate(visits) if v.first is not None]
        began[[i for i, _ in firsts], columns[[at for _, at in firsts]]] = 1.0
        scaled = states * np.asarray(self.group.scale)
        near = cdist(scaled, scaled) <= self.radius
        reached, began = _anywhere(reached, near), _anywhere(began, near)
        values = _share(reached[success]) - _share(reached[~success])
        values[began.mean(axis=0) > MAX_START_SHARE] = NO_PLACE
        self._values = {_key(state): float(value) for state, value in zip(states, values, strict=True)}

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint. Visits are not in it: they follow from the trajectories."""
        return {
            "states": np.array([np.frombuffer(key) for key in self._values]),
            "values": np.array(list(self._values.values())),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._values = {_key(of): float(value) for of, value in zip(state["states"], state["values"], strict=True)}
        self._visits = {}

    @property
    def n_states(self) -> int:
        """Distinct states of the group in the trajectories."""
        return len(self._values)

    def largest(self) -> float:
        """Of all states; `NO_PLACE` where there is none."""
        return max(self._values.values(), default=NO_PLACE)

    def of(self, features: FloatArray) -> FloatArray:
        """The contrast of states by all their features (m, d), shape (m,); they were in an updated trajectory."""
        places = self.group.is_place(features)
        values = np.full(len(features), NO_PLACE)
        values[places] = [self._values[_key(state)] for state in self.group.own(features[places])]
        return values

    def stands_out(self, features: FloatArray, least: float) -> BoolArray:
        """Which states (m, d) have a contrast of ``least``, and more than in a part of the group, shape (m,)."""
        values = self.of(features)
        enough: BoolArray = values >= least
        for part in self.parts:
            enough &= values >= part.of(features) + PAIR_GAIN
        return enough


class _Visits:
    """The distinct places of a group that a trajectory visited, (n, k), when first, and which it began in, if any."""

    def __init__(self, labelled: LabelledTrajectory, group: FeatureGroup) -> None:
        self.labelled = labelled  # kept, so that no other takes its id
        places = group.is_place(labelled.features)
        self.states, which = np.unique(group.own(labelled.features[places]), axis=0, return_inverse=True)
        self.first = int(which.ravel()[0]) if places[0] else None
        came = np.unique(labelled.trajectory.visits, return_index=True)[1]  # when to each observation
        self.times = np.full(len(self.states), came.max(initial=0))
        np.minimum.at(self.times, which.ravel(), came[places])


def _anywhere(reached: FloatArray, near: BoolArray) -> FloatArray:
    """For each state (n, states) the most of those near it; a state is near itself."""
    most = reached.copy()
    for state in np.flatnonzero(near.sum(axis=0) > 1):
        most[:, state] = reached[:, near[:, state]].max(axis=1)
    return most


def _share(reached: FloatArray) -> FloatArray:
    shares: FloatArray = (reached.sum(axis=0) + 1.0) / (len(reached) + 2.0)
    return shares


def _key(state: FloatArray) -> bytes:
    return (state + 0.0).tobytes()  # -0.0 and 0.0 are one state
