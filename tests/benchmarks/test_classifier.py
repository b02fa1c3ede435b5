from __future__ import annotations

import numpy as np
import pytest
from sklearn.base import clone, is_classifier
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.utils.validation import check_is_fitted

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


def test_scikit_learn_clones_splits_scores_and_selects() -> None:
    bags, labels = bags_and_labels(0)
    classifier = DiverseDensityClassifier(steps=10, max_starts=20)
    assert clone(classifier).get_params() == classifier.get_params()
    assert is_classifier(classifier)
    assert cross_val_score(classifier, bags, labels, cv=3, scoring="roc_auc").mean() > 0.6
    selected = GridSearchCV(classifier, {"steps": [5, 10]}, cv=2).fit(bags, labels)
    check_is_fitted(selected.best_estimator_)
    with pytest.raises(NotFittedError):
        check_is_fitted(classifier)
    with pytest.raises(ValueError, match="Invalid parameter 'step' for estimator"):
        classifier.set_params(step=1)
