from __future__ import annotations

import numpy as np
import pytest
import torch

from experiments.common.em_dd import ExpectationMaximisation, MostLikely
from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity
from tests.density.planted import planted

FIXED = DiverseDensity(method="thorough", max_starts=64)


def test_the_objective_by_hand() -> None:
    bags = Bags.pack([np.array([[0.0], [5.0]]), np.array([[2.0]])], [np.array([[3.0], [1.5]])])
    evidence = FIXED.evidence(bags)
    likelihood = MostLikely(bags, evidence, FIXED.concept, 0.5)
    theta = torch.tensor([[1.0]], dtype=torch.float64) - torch.from_numpy(evidence.origin)
    selected = likelihood.select(theta)
    assert selected[:, 0].tolist() == [0, 2, 4]
    value, gradient = likelihood.loss(theta, selected)
    assert value.item() == pytest.approx(1 + 1 - np.log1p(-0.5 * np.exp(-0.25)))
    step = 1e-6
    slope = (likelihood.loss(theta + step, selected)[0] - likelihood.loss(theta - step, selected)[0]) / (2 * step)
    assert gradient.item() == pytest.approx(slope.item(), rel=1e-6)


def test_finds_what_was_planted() -> None:
    peaks = ExpectationMaximisation(search=FIXED).fit(planted(0, 5))
    values = [peak.log_density for peak in peaks]
    assert values == sorted(values, reverse=True)
    assert peaks[0].converged
    assert np.linalg.norm(peaks[0].region().points[0] - [3, -2]) < 0.5
