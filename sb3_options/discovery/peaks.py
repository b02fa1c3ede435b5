"""Running averages find peaks of diverse density that appear early and persist (McGovern & Barto 2001, §5)."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from sb3_options.experience.observations import FloatArray
from sb3_options.state import storable

PEAK_RADIUS = 1.5
"""Peaks within this distance, in scaled units, touch. A peak belongs to the nearest concept within it."""

MOST_TIED = 1000  # more tied peaks, or equally often visited places, are no subgoals


def plateau_centres(points: FloatArray, scale: FloatArray, radius: float) -> FloatArray:
    """Join tied peaks that touch into plateaus, and return the centre of each plateau.

    In two rooms every crossing visits the doorway and both its neighbours, so the three tie exactly. The one in the
    middle is the doorway.
    """
    distances = cdist(points * scale, points * scale)
    n_plateaus, plateau = connected_components(distances <= radius, directed=False)
    members = [np.flatnonzero(plateau == number) for number in range(n_plateaus)]
    return np.array([points[of[distances[of][:, of].sum(axis=1).argmin()]] for of in members])


@storable
@dataclass
class TrackedConcept:
    """A concept that was a peak at least once."""

    point: FloatArray  # where it was last found, (d,)
    average: float  # c̄, in [0, λ/(1−λ))
    found: bool = False  # by the last search


class PeakTracker:
    """Running averages c̄ of how often each concept is a peak.

    After every search c̄ ← λ(c̄ + 1) for a concept that it found, and c̄ ← λ c̄ for the others. So c̄ of a concept
    found every time rises to λ/(1−λ). In a continuous space no point is found twice. So a peak belongs to the nearest
    known concept within ``radius``.
    """

    STATE = ("concepts",)

    FORGOTTEN = 1e-3  # a concept is dropped once its average decays below this, to keep the list short

    def __init__(self, *, decay: float = 0.9, radius: float = 1.0) -> None:
        self.decay = decay
        self.radius = radius
        self.concepts: list[TrackedConcept] = []

    @property
    def limit(self) -> float:
        """λ/(1−λ), the average of a concept that is always found."""
        return self.decay / (1.0 - self.decay)

    def update(self, peaks: FloatArray, scale: FloatArray) -> None:
        """Enter the peaks of one search."""
        for concept in self.concepts:
            concept.found = False
        for peak in peaks:
            known = self._nearest(peak, scale)
            if known is None:
                known = TrackedConcept(np.array(peak, dtype=np.float64), 0.0)
                self.concepts.append(known)
            if not known.found:
                known.point = np.array(peak, dtype=np.float64)  # the newest search knows the most bags
                known.found = True
        for concept in self.concepts:
            concept.average = self.decay * (concept.average + concept.found)
        self.concepts = [c for c in self.concepts if c.found or c.average > self.FORGOTTEN]

    def leading_average(self) -> float:
        """Return the largest average, 0 before the first peak."""
        return max((concept.average for concept in self.concepts), default=0.0)

    def persistent(self, threshold: float) -> list[TrackedConcept]:
        """Return concepts of the last search whose average exceeds this share of the limit, largest first."""
        above = [c for c in self.concepts if c.found and c.average > threshold * self.limit]
        return sorted(above, key=lambda c: -c.average)

    def _nearest(self, peak: FloatArray, scale: FloatArray) -> TrackedConcept | None:
        if not self.concepts:
            return None
        points = np.stack([c.point for c in self.concepts])
        distances = np.linalg.norm((points - peak) * scale, axis=1)
        nearest = int(distances.argmin())
        return self.concepts[nearest] if distances[nearest] <= self.radius else None
