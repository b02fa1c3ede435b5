"""When an option is worth learning anew: each time twice as many trajectories have reached its subgoal."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience.trajectories import LabelledTrajectory


class OptionGrowth:
    """Counts, slot by slot, the trajectories that reached the option's subgoal.

    An option is made from the few trajectories there are by then, and its initiation set holds no more than what they
    passed. Learning it anew at every doubling costs no more than two options learned from all of them, and lets the
    initiation set become what the paper's definition makes of everything lived through.
    """

    def __init__(self) -> None:
        self._reached: dict[int, int] = {}
        self._learned_from: dict[int, int] = {}

    def made(self, slot: int, subgoal: Region, trajectories: Iterable[LabelledTrajectory]) -> None:
        """Note that the option in ``slot`` was made from ``trajectories``."""
        self._reached[slot] = self._learned_from[slot] = sum(_reaches(subgoal, t) for t in trajectories)

    def is_due(self, slot: int, subgoal: Region, trajectory: LabelledTrajectory) -> bool:
        """Whether the option in ``slot`` is to be learned anew, now that there is one more trajectory.

        Args:
            slot: Of the option.
            subgoal: Of the option.
            trajectory: The new one.

        Returns:
            True at every doubling; never for an option that was not `made` here.
        """
        if slot not in self._reached:
            return False
        self._reached[slot] += _reaches(subgoal, trajectory)
        if self._reached[slot] < 2 * self._learned_from[slot]:
            return False
        self._learned_from[slot] = self._reached[slot]
        return True


def _reaches(subgoal: Region, trajectory: LabelledTrajectory) -> bool:
    return bool(np.any(subgoal.contains(trajectory.features)))
