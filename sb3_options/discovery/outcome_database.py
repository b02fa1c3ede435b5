"""The database of discovery on groups of features: successes and failures apart."""

from __future__ import annotations

from collections.abc import Iterator

from sb3_options.discovery.salience import Salience
from sb3_options.experience.trajectories import LabelledTrajectory, TrajectoryDatabase


class OutcomeDatabase(TrajectoryDatabase):
    """The last ``capacity`` successful trajectories and as many of the others, each with its own ``max_bytes``.

    Where few trajectories succeed, the last ones of all hardly hold any that did. What counts as a success is decided
    anew when other things are rare (`Salience`).

    Attributes:
        n_entered: Successes that were added; those of which something else is rare now count again.
    """

    STATE = ("_salience", "n_entered")

    def __init__(self, capacity: int, max_bytes: float, salience: Salience) -> None:
        super().__init__(capacity, max_bytes)
        self._salience = salience
        self.n_entered = 0

    def add(self, trajectory: LabelledTrajectory) -> None:
        """Append, dropping the oldest one of its kind when there are too many."""
        if self._salience.add(trajectory):
            wholes = [each.whole or each for each in self._trajectories]
            self._trajectories = [self._salience.label(each) for each in wholes]
            self.n_entered += self.n_successful - sum(each.success for each in wholes)
        labelled = self._salience.label(trajectory)
        self.n_entered += labelled.success
        every = [*self._trajectories, labelled]
        kept = [self._newest([each for each in every if each.success is kind]) for kind in (False, True)]
        ids = {id(each) for kind in kept for each in kind}
        self._trajectories = [each for each in every if id(each) in ids]

    def __iter__(self) -> Iterator[LabelledTrajectory]:
        """The unsuccessful ones, then the successful ones, each oldest first."""
        return iter(sorted(self._trajectories, key=lambda each: each.success))
