"""Diverse density of bags that hold everything, as the paper's do: what is common by accident is told by its shape."""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from sb3_options.discovery.methods.diverse_density import PEAK_TOLERANCE, PersistentPeaks
from sb3_options.discovery.peaks import PEAK_RADIUS
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

    def places(self) -> FloatArray:
        """The middles of the best peaks' plateaus; none where there are too many, or one is too wide."""
        places, scale = super().places(), self.filters.known_scale
        least = self.peaks[0].log_density - PEAK_TOLERANCE
        tied = np.array([peak.point for peak in self.peaks if peak.log_density >= least])
        few = 0 < len(places) <= self.max_places
        return places if few and extent_of(tied, places, scale, PEAK_RADIUS) <= self.max_extent else places[:0]


def extent_of(points: FloatArray, middles: FloatArray, scale: FloatArray, radius: float) -> float:
    """How far the widest plateau of some points reaches from its middle (`plateau_centres`)."""
    scaled = points * scale
    plateau = connected_components(cdist(scaled, scaled) <= radius, directed=False)[1]
    return float(np.linalg.norm(scaled - middles[plateau] * scale, axis=1).max())
