"""A control of diverse density: subgoals that are drawn from the states that it searches."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.discovery.methods import Experience
from sb3_options.discovery.methods.diverse_density import PersistentPeaks


class FilteredStates(PersistentPeaks):
    """Proposes a state of the positive bags, each as likely, as soon as the filters leave any.

    Bags, budget and spacing are diverse density's own. What is missing is the density, and the wait for a peak that
    persists.

    Args:
        seed: Of the draws.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_random",)

    def __init__(self, *, seed: int = 0) -> None:
        super().__init__()
        self._random = np.random.default_rng(seed)

    def update(self, experience: Experience) -> list[Region]:
        """Make the bags and draw; as `DiscoveryMethod.update`."""
        self._n_since = 0
        self.evidence = self.bags(experience)
        if self.evidence is None:
            return []
        places = np.unique(np.concatenate(self.evidence.positive), axis=0)
        point = places[self._random.integers(len(places))]
        return [Region(point[None], self.filters.known_scale, self.settings.subgoal_radius)]

    def accept(self, goal: Region) -> float:
        """There are no running averages; as `Method.accept`."""
        self._n_accepted += 1
        return float("nan")
