"""What a search found."""

from __future__ import annotations

from typing import NamedTuple

from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import Peak
from sb3_options.density.regions import Region
from sb3_options.discovery.bag_maker import FilteredBags
from sb3_options.discovery.settings import described
from sb3_options.experience.observations import FloatArray, Observations
from sb3_options.options.proposals import Proposal


class Search(NamedTuple):
    """What one search found.

    Attributes:
        peaks: Best first; empty if there was nothing to search.
        evidence: What was searched; None if there was nothing.
        seconds: Wall time.
    """

    peaks: list[Peak]
    evidence: FilteredBags | None
    seconds: float

    @property
    def bags(self) -> Bags | None:
        """What was searched; None if there was nothing."""
        return None if self.evidence is None else self.evidence.bags


class FoundSubgoal(NamedTuple):
    """A subgoal, with the bags it was found in.

    Attributes:
        subgoal: In concept space.
        bags: Of the search that completed it; None where another method found it.
        log_density: Best log diverse density of that search; NaN likewise.
        proposal: What the option is to be made for, if not to reach it.
        observation: Where it was found, a batch of one; None where another method found it.
    """

    subgoal: Region
    bags: Bags | None
    log_density: float
    proposal: Proposal | None = None
    observation: Observations | None = None

    @property
    def centre(self) -> FloatArray:
        """The middle of the subgoal in its own features, (d,)."""
        centre: FloatArray = self.subgoal.points[0]
        return centre

    def where(self, kind: str | None) -> str:
        """The subgoal for people; ``kind`` says where φ comes from."""
        return described(self.centre, kind, self.subgoal.group)
