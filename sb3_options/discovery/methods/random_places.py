"""A control: random places."""

from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.method import Experience, Method


@dataclass(kw_only=True, eq=False)
class RandomPlaces(Method):
    """A control that proposes a random place of each successful trajectory, from the ``min_successes``-th one on."""

    STATE = ("_successes", "_random")

    needs_success = True

    min_successes: Annotated[int, Field(ge=1)] = 4
    seed: Annotated[int, Field(ge=0)] = 0

    def __post_init__(self) -> None:
        """Set up the random generator."""
        self._random = np.random.default_rng(self.seed)
        self._successes = 0

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        self._successes += experience.success
        allowed = np.flatnonzero(experience.places.allowed)
        if not experience.success or self._successes < self.min_successes or not len(allowed):
            return []
        return [experience.region(experience.places.points[self._random.choice(allowed)])]
