"""The database of discovery on groups of features: successes and failures apart."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from typing import Any

from sb3_options.discovery.salience import Salience
from sb3_options.experience.trajectories import LabelledTrajectory, TrajectoryDatabase


class OutcomeDatabase(TrajectoryDatabase):
    """The last ``capacity`` successful trajectories and as many of the others.

    Where few trajectories succeed, the last ones of all hardly hold any that did.

    Args:
        capacity: Of each kind, at least 1.
        max_bytes: Likewise.
        salience: Which failures stand for successes; None: none does.

    Attributes:
        n_entered: How many entered as successes so far.

    Raises:
        ValueError: ``capacity`` < 1.
    """

    def __init__(self, capacity: int, max_bytes: float = math.inf, salience: Salience | None = None) -> None:
        super().__init__(capacity, max_bytes)
        self._successful = TrajectoryDatabase(capacity, max_bytes)
        self._salience = Salience((), 0.0, 0) if salience is None else salience
        self.n_entered = 0

    def add(self, trajectory: LabelledTrajectory) -> None:
        """Append, dropping the oldest one of its kind when there are too many."""
        others: list[LabelledTrajectory] = []
        if self._salience.add(trajectory):
            others = [each if each.whole is None else each.whole for each in self]
            self.n_entered -= sum(each.success for each in others)
            super().clear()
            self._successful.clear()
        for each in map(self._salience.label, [*others, trajectory]):
            self.n_entered += each.success
            (self._successful.add if each.success else super().add)(each)

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint: the trajectories of each kind, oldest first, and what is rare."""
        successful, salience = self._successful.get_state(), self._salience.get_state()
        return {**super().get_state(), "successful": successful, "salience": salience, "n_entered": self.n_entered}

    def set_state(self, state: dict[str, Any]) -> None:
        """Hold what `get_state` gave, and nothing else."""
        super().set_state(state)
        self._successful.set_state(state["successful"])
        self._salience.set_state(state["salience"])
        self.n_entered = state["n_entered"]

    @property
    def n_successful(self) -> int:
        """How many successful ones there are."""
        return len(self._successful)

    def __len__(self) -> int:
        return super().__len__() + len(self._successful)

    def __iter__(self) -> Iterator[LabelledTrajectory]:
        """The unsuccessful ones, then the successful ones, each oldest first."""
        return chain(super().__iter__(), self._successful)
