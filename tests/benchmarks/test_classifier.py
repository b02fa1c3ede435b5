from __future__ import annotations

import numpy as np

from benchmarks.diverse_density.classifier import DiverseDensityClassifier
from sb3_options.density.arrays import BoolArray, FloatArray


def bags_and_labels(seed: int, n: int = 30) -> tuple[list[FloatArray], BoolArray]:
    """Noise, with an instance near (1, −1, 1, …) in the first half of the features of every positive bag."""
    rng = np.random.default_rng(seed)
    bags = [rng.normal(scale=2, size=(int(rng.integers(2, 8)), 6)) for _ in range(n)]
    for bag in bags[: n // 2]:
        bag[0, :3] = rng.normal([2, -2, 2], 0.3)
    return bags, np.arange(n) < n // 2


def test_learns_and_generalises() -> None:
    bags, labels = bags_and_labels(0, 120)
    classifier = DiverseDensityClassifier().fit(bags[::2], labels[::2])
    assert classifier.score(bags[1::2], labels[1::2]) >= 0.85
    probabilities = classifier.predict_proba(bags)
    assert probabilities.shape == (120, 2)
    np.testing.assert_allclose(probabilities.sum(1), 1)
    assert probabilities.min() >= 0
    assert classifier.n_features_in_ == 6
