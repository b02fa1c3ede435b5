"""A control of diverse density: subgoals that are drawn from the states that it searches."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.discovery.found import FoundSubgoal, Search
from sb3_options.discovery.subgoals import SubgoalDiscovery


@dataclass
class FilteredDiscovery(SubgoalDiscovery):
    """Draws a subgoal as soon as the filters leave something: a state of the positive bags, each as likely.

    Bags, budget and spacing are diverse density's own. What is missing is the density, and the wait for a peak that
    persists.

    Args:
        seed: Of the draws.
    """

    seed: int = field(default=0, kw_only=True)

    def __post_init__(self) -> None:
        """Set up the generator."""
        super().__post_init__()
        self._random = np.random.default_rng(self.seed)

    def update(self) -> None:
        """Make the bags; as `SubgoalDiscovery.update`."""
        began = time.perf_counter()
        self.last = Search([], self._recurring_evidence(), time.perf_counter() - began)
        self.seconds += self.last.seconds

    def _new_subgoal(self) -> Region | None:
        if self.last.evidence is None:
            return None
        assert self.scale is not None  # there are bags
        places = np.unique(np.concatenate(self.last.evidence.positive), axis=0)
        point = places[self._random.integers(len(places))]
        subgoal = Region(point[None], self.scale, self.settings.subgoal_radius)
        self.found.append(FoundSubgoal(subgoal, self.last.evidence.bags, math.nan))
        self._maker.forget_bags()
        return subgoal
