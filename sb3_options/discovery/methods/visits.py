"""Frequencies of first visits, and a control: random places."""

from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.candidates import CandidateMethod
from sb3_options.discovery.methods.method import Experience, Method
from sb3_options.discovery.peaks import MOST_TIED, PeakTracker, plateau_centres
from sb3_options.experience.observations import FloatArray, IntArray


@dataclass(kw_only=True, eq=False)
class FirstVisits(CandidateMethod):
    """McGovern & Barto (2001), §3: the place that most successful trajectories visit.

    It must persist: its running average (their §5) must exceed a share of its limit.

    Args:
        decay: λ of the running averages.
        threshold: Share of the limit λ/(1−λ).
        min_successes: Successful trajectories before the first place counts.
        radius: Places within this distance of each other are one, in scaled units.
    """

    STATE = ("_successes", "_tracker")

    needs_success = True

    decay: Annotated[float, Field(gt=0, lt=1)] = 0.75
    threshold: Annotated[float, Field(ge=0, lt=1)] = 0.6
    min_successes: Annotated[int, Field(ge=1)] = 4
    radius: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.5

    def __post_init__(self) -> None:
        """Begin without places."""
        super().__init__()
        self._tracker = PeakTracker(decay=self.decay, radius=self.radius)
        self._successes = 0

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        if not experience.success:
            return []
        self._successes += 1
        visits = np.bincount(experience.places.visits)
        most = self._counted(experience, visits, self._hits(visits))
        if self._successes < self.min_successes or not most:
            return []
        points = np.array([region.points[0] for region in most[: MOST_TIED + 1]])
        few = len(points) <= MOST_TIED
        centres = plateau_centres(points, experience.scale, self.radius) if few else points[:0]
        self._tracker.update(centres, experience.scale)
        return [experience.region(concept.point) for concept in self._tracker.persistent(self.threshold)]

    def _hits(self, visits: IntArray) -> IntArray:
        """What counts of how often a trajectory visited each place, (k,)."""
        return np.ones_like(visits)

    def _accepted(self, seen: FloatArray, hits: FloatArray) -> FloatArray:
        """The most visited places, ties included."""
        return np.asarray(hits == hits.max(), dtype=np.float64)

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        return super().seconds(experience) if experience.success else 0.0


@dataclass(kw_only=True, eq=False)
class RandomPlaces(Method):
    """A control: a random place of a successful trajectory.

    Args:
        min_successes: Successful trajectories before the first proposal.
        seed: Of the generator that draws.
    """

    STATE = ("_successes", "_random")

    needs_success = True

    min_successes: Annotated[int, Field(ge=1)] = 4
    seed: Annotated[int, Field(ge=0)] = 0

    def __post_init__(self) -> None:
        """Begin to draw."""
        self._random = np.random.default_rng(self.seed)
        self._successes = 0

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        self._successes += experience.success
        allowed = np.flatnonzero(experience.places.allowed)
        if not experience.success or self._successes < self.min_successes or not len(allowed):
            return []
        return [experience.region(experience.places.points[self._random.choice(allowed)])]
