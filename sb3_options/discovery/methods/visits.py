"""Visit frequencies, and a control: random places."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, validate_call

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.candidates import PLACE_SECONDS, Candidates
from sb3_options.discovery.methods.method import Experience, Method
from sb3_options.discovery.peaks import MOST_TIED, PeakTracker, plateau_centres
from sb3_options.experience.observations import FloatArray


class VisitFrequency(Method):
    """McGovern & Barto (2001), §3: the place that successful trajectories visit most.

    It must persist: its running average (their §5) must exceed a share of its limit.

    Args:
        count: The ``first`` visit of a place in a trajectory, or ``every`` one.
        decay: λ of the running averages.
        threshold: Annotated[float, Field(gt=0, lt=1)] of the limit λ/(1−λ).
        min_successes: Successful trajectories before the first place counts.
        radius: Places within this distance of each other are one, in scaled units.
    """

    STATE = ("_successes", "_visited", "_tracker")

    needs_success = True

    @validate_call
    def __init__(
        self,
        count: Literal["first", "every"] = "first",
        *,
        decay: Annotated[float, Field(gt=0, lt=1)] = 0.75,
        threshold: Annotated[float, Field(ge=0, lt=1)] = 0.6,
        min_successes: Annotated[int, Field(ge=1)] = 4,
        radius: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.5,
    ) -> None:
        self.count, self.min_successes, self.radius = count, min_successes, radius
        self.decay, self.threshold = decay, threshold
        self._visited = Candidates(_most)
        self._tracker = PeakTracker(decay=decay, threshold=threshold, radius=radius)
        self._successes = 0

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        if not experience.success:
            return []
        self._successes += 1
        visits = np.bincount(experience.places.visits)
        self._visited.add(experience, visits, np.ones_like(visits) if self.count == "first" else visits)
        most = self._visited.proposals(experience)
        if self._successes < self.min_successes or not most:
            return []
        points = np.array([region.points[0] for region in most[: MOST_TIED + 1]])
        centres = points[:0]
        if len(points) <= MOST_TIED:
            centres, _ = plateau_centres(points, experience.scale, self.radius)
        self._tracker.update(centres, experience.scale)
        return [experience.region(concept.point) for concept in self._tracker.persistent()]

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        return PLACE_SECONDS * len(self._visited) if experience.success else 0.0


def _most(seen: FloatArray, hits: FloatArray) -> FloatArray:
    """Accept the most visited places, ties included."""
    del seen
    accepted: FloatArray = (hits == hits.max()).astype(np.float64)
    return accepted


class RandomPlaces(Method):
    """A control: a random place of a successful trajectory.

    Args:
        min_successes: Successful trajectories before the first proposal.
        seed: Of the generator that draws.
    """

    STATE = ("_successes", "_random")

    needs_success = True

    @validate_call
    def __init__(
        self, *, min_successes: Annotated[int, Field(ge=1)] = 4, seed: Annotated[int, Field(ge=0)] = 0
    ) -> None:
        self.min_successes = min_successes
        self._random = np.random.default_rng(seed)
        self._successes = 0

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        self._successes += experience.success
        allowed = np.flatnonzero(experience.places.allowed)
        if not experience.success or self._successes < self.min_successes or not len(allowed):
            return []
        return [experience.region(experience.places.points[self._random.choice(allowed)])]
