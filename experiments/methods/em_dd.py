"""EM-DD as an entrant of the race: one instance speaks for each bag (Zhang & Goldman 2001)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from experiments.common.em_dd import ExpectationMaximisation, MostLikely
from sb3_options.density.bags import distinct
from sb3_options.density.diverse_density import DiverseDensity, Peak
from sb3_options.discovery.bags import FilteredBags
from sb3_options.discovery.budget import POINT_FEATURES, nominal_seconds
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.experience.observations import FloatArray

STARTS, ROUNDS, STEPS = 32, 5, 10
"""Instances of positive bags that are started from, selections, and evaluations between two of them."""

EVALUATION_SECONDS = 4e-5
"""Nominal time of an evaluation of few instances."""


class MostLikelyPeaks(PersistentPeaks):
    """`PersistentPeaks` with `ExpectationMaximisation` in place of diverse density.

    Bags, filters, peaks that persist and subgoals are those of diverse density. `leak` and ``search`` have no effect:
    all bags must have an instance near the concept. One-hot codes have no point between them, so only the instances of
    positive bags are candidates.
    """

    def _certain(self, evidence: FilteredBags, engine: DiverseDensity, starts: FloatArray | None) -> list[Peak]:
        return engine.certain(evidence.positive, evidence.positive[0])

    def _search(self, evidence: FilteredBags, engine: DiverseDensity, starts: FloatArray | None) -> list[Peak]:
        search = replace(engine, method="thorough", max_starts=STARTS)
        if self.filters.kind != "categorical":
            return ExpectationMaximisation(search=search, rounds=ROUNDS, steps=STEPS).fit(evidence.bags)
        scaled = search.evidence(evidence.bags)
        likelihood = MostLikely(evidence.bags, scaled, search.concept, search.negative_strength)
        points = distinct(evidence.bags.smallest_positive(evidence.bags.n_positive))
        theta = torch.from_numpy(np.ascontiguousarray(scaled.scaled(points).T))
        loss, _ = likelihood.loss(theta, likelihood.select(theta))
        return engine.best(points, -loss.numpy())

    def _seconds_of_search(self, evidence: FilteredBags, engine: DiverseDensity) -> float:
        if self.filters.kind == "categorical":
            return super()._seconds_of_search(evidence, engine)
        n_pairs = evidence.n_instances * STARTS * (ROUNDS + 1)
        compared = nominal_seconds(search=1, pair=n_pairs * (evidence.n_features + POINT_FEATURES))
        return compared + EVALUATION_SECONDS * ROUNDS * (STEPS + 1)
