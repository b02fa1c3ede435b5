"""What an option may be made for: a region to reach, a passage to one, or a reward to gain."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.state import storable


@storable
@dataclass(frozen=True)
class Passage:
    """Reach a region from within a set of states, and stay in that set on the way.

    Attributes:
        subgoal: Where the option ends.
        initiation: I: where it may start, and go on.
    """

    subgoal: Region
    initiation: Region

    def __post_init__(self) -> None:
        """Refuse anything but a region."""
        for name in ("subgoal", "initiation"):
            if not isinstance(value := getattr(self, name), Region):
                raise TypeError(f"{name} of a Passage must be a Region, got {value!r:.200}")


@storable
@dataclass(frozen=True, eq=False)
class IntrinsicReward:
    """Gain r(s, s') = f(s') − f(s) as long as there is something to gain (Machado et al. 2017, eq. 2).

    f is known at places: bins of concept space, one unit wide. A step from or to another place says nothing.

    Attributes:
        points: One state of each place, (n, d).
        potentials: f there, (n,), finite.
        scale: Factor for every feature that makes one unit one step, (d,).
        radius: Of the regions that the option's I and β are made of, in scaled units.
    """

    points: FloatArray
    potentials: FloatArray
    scale: FloatArray
    radius: float

    def __post_init__(self) -> None:
        """Refuse what does not fit."""
        shapes = np.shape(self.points), np.shape(self.potentials), np.shape(self.scale)
        if len(shapes[0]) != 2 or shapes[0][0] < 1 or shapes[1:] != (shapes[0][:1], shapes[0][1:]):
            raise ValueError(f"points, potentials and scale must be (n, d), (n,) and (d,), n ≥ 1, got {shapes}")
        for name in ("points", "potentials", "scale"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        if not np.isfinite(self.potentials).all():
            raise ValueError("potentials must be finite")
        if len(self._row_of) < len(self.points):
            raise ValueError("points must be of different places: bins of concept space, one unit wide")

    @cached_property
    def _row_of(self) -> dict[bytes, int]:
        return {place.tobytes(): row for row, place in enumerate(bins_of(self.points, self.scale))}

    def rows(self, features: FloatArray) -> tuple[IntArray, BoolArray]:
        """The place of each state (m, d): its row in ``points``, (m,), and whether there is one, (m,)."""
        rows = np.array(
            [self._row_of.get(place.tobytes(), -1) for place in bins_of(features, self.scale)], dtype=np.int64
        )
        return rows, rows >= 0

    @property
    def summit(self) -> Region:
        """The place where f is largest."""
        return Region(self.points[[self.potentials.argmax()]], self.scale, self.radius)


Proposal: TypeAlias = Region | Passage | IntrinsicReward
"""What an option may be made for."""


def everywhere(n_features: int) -> Region:
    """A region of concept space that holds all states: distances are 0."""
    return Region(np.zeros((1, n_features)), np.zeros(n_features), 0.0)


def goal_of(proposal: Proposal) -> Region:
    """Where an option for this leads, as far as it is known before it is learned."""
    if isinstance(proposal, Passage):
        return proposal.subgoal
    return proposal.summit if isinstance(proposal, IntrinsicReward) else proposal


def bins_of(features: FloatArray, scale: FloatArray) -> FloatArray:
    """States (m, d) binned at one unit of concept space, (m, d): those in one bin are one place."""
    bins: FloatArray = np.rint(features * scale) + 0.0  # -0.0 and 0.0 are one bin, but not the same bytes
    return bins
