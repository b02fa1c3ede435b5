"""Diverse density of bags that hold everything, as the paper's do: what is common by accident is told by its shape."""

from __future__ import annotations

import math

from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.experience.observations import FloatArray


class FewPeaks(PersistentPeaks):
    """Counts the best peaks of a search only where they are few places, none of them wide.

    Args:
        max_places: If more separate places share the best density, they are accidents of few or long trajectories.
        max_extent: A plateau of tied peaks that reaches farther than this from its middle, in scaled units, is open
            space that all trajectories happened to cross.
    """

    cut_threshold = 1.0  # no state is known to cut off its surroundings

    def __init__(self, max_places: float, max_extent: float = math.inf) -> None:
        super().__init__()
        self.max_places = max_places
        self.max_extent = max_extent

    def places(self) -> tuple[FloatArray, float]:
        """The middles of the best peaks' plateaus, and the extent of the widest."""
        places, extent = super().places()
        return (places if len(places) <= self.max_places and extent <= self.max_extent else places[:0]), extent
