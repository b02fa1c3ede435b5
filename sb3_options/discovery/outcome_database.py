"""The database of discovery on groups of features: successes and failures apart."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from typing import Any

from sb3_options.discovery.salience import Salience
from sb3_options.experience.trajectories import LabelledTrajectory, TrajectoryDatabase
from sb3_options.state import restore, state_of


class OutcomeDatabase(TrajectoryDatabase):
    """The last ``capacity`` successful trajectories and as many of the others.

    Where few trajectories succeed, the last ones of all hardly hold any that did.
    """

    STATE = ("_successful", "_salience", "n_entered")

    def __init__(self, capacity: int, max_bytes: float = math.inf, salience: Salience | None = None) -> None:
        super().__init__(capacity, max_bytes)
        self._successful = TrajectoryDatabase(capacity, max_bytes)
        self._salience = Salience((), 0.0, 0) if salience is None else salience
        self.n_entered = 0
        self._n_added = 0
        self._number: dict[int, int] = {}  # of each whole trajectory, by its id, in the order in which they came

    def add(self, trajectory: LabelledTrajectory) -> None:
        """Append, dropping the oldest one of its kind when there are too many."""
        others: list[LabelledTrajectory] = []
        self._note(trajectory)
        if self._salience.add(trajectory):
            others = sorted(map(_whole, self), key=lambda each: self._number[id(each)])
            self.n_entered -= sum(each.success for each in others)
            super().clear()
            self._successful.clear()
        for each in map(self._salience.label, [*others, trajectory]):
            self.n_entered += each.success
            (self._successful.add if each.success else super().add)(each)

    def _note(self, trajectory: LabelledTrajectory) -> None:
        """Note when a trajectory came."""
        if len(self._number) > 4 * self.capacity:
            self._number = {id(whole): self._number[id(whole)] for whole in map(_whole, self)}
        self._number[id(trajectory)] = self._n_added
        self._n_added += 1

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint: the trajectories of each kind, oldest first, and the rare events."""
        return {**state_of(self), "numbers": [self._number[id(_whole(each))] for each in self]}

    def set_state(self, state: dict[str, Any]) -> None:
        """Hold what `get_state` gave, and nothing else."""
        restore(self, state)
        numbers = state["numbers"]
        self._number = {id(_whole(each)): number for each, number in zip(self, numbers, strict=True)}
        self._n_added = 1 + max(numbers, default=-1)

    @property
    def n_successful(self) -> int:
        """How many successful ones there are."""
        return len(self._successful)

    def __len__(self) -> int:
        return super().__len__() + len(self._successful)

    def __iter__(self) -> Iterator[LabelledTrajectory]:
        """The unsuccessful ones, then the successful ones, each oldest first."""
        return chain(super().__iter__(), self._successful)


def _whole(trajectory: LabelledTrajectory) -> LabelledTrajectory:
    """What a trajectory was made of: itself, if it is no part."""
    return trajectory if trajectory.whole is None else trajectory.whole
