"""Discovery by EM-DD: one instance speaks for each bag (Zhang & Goldman 2001)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sb3_options.density.bags import distinct
from sb3_options.density.diverse_density import DiverseDensity, Peak
from sb3_options.density.em_dd import ExpectationMaximisation
from sb3_options.density.one_hot import one_hot_log_density
from sb3_options.discovery.bag_maker import FilteredBags
from sb3_options.discovery.budget import seconds_of_search
from sb3_options.discovery.subgoals import SubgoalDiscovery

STARTS, ROUNDS, STEPS = 32, 5, 10
"""Instances of positive bags that are started from, selections, and evaluations between two of them."""

EVALUATION_SECONDS = 4e-5
"""Nominal time of an evaluation of few instances."""


@dataclass
class MostLikelyDiscovery(SubgoalDiscovery):
    """`SubgoalDiscovery` with `ExpectationMaximisation` in place of diverse density.

    Bags, filters, peaks that persist and subgoals are as for diverse density. `leak` and ``search`` have no effect: all
    bags must have an instance near the concept. Between one-hot codes there is nothing to ascend to, so there the
    likelihood is evaluated at the instances of positive bags.
    """

    def _certain(self, evidence: FilteredBags, engine: DiverseDensity) -> list[Peak]:
        """They have density 1 here, too: the nearest instance speaks for each bag."""
        return engine.certain(evidence.positive, evidence.positive[0])

    def _peaks(self, evidence: FilteredBags, engine: DiverseDensity) -> list[Peak]:
        if self.kind == "categorical":
            bags, scale = evidence.bags, float(np.max(engine.scale))
            points = distinct(bags.smallest_positive(bags.n_positive))
            strength = engine.negative_strength
            return engine.best(points, one_hot_log_density(points, scale, bags, strength, 0.0, one_speaks=True))
        search = replace(engine.concepts, max_starts=STARTS)
        return engine.peaks(ExpectationMaximisation(search=search, rounds=ROUNDS, steps=STEPS).fit(evidence.bags))

    def _seconds_of_search(self, evidence: FilteredBags, engine: DiverseDensity, *, certain: bool) -> float:
        if certain or self.kind == "categorical":
            return super()._seconds_of_search(evidence, engine, certain=certain)
        evaluations = ROUNDS * (STEPS + 1)
        compared = seconds_of_search(evidence.n_instances, STARTS * (ROUNDS + 1), evidence.positive[0].shape[1])
        return compared + EVALUATION_SECONDS * evaluations
