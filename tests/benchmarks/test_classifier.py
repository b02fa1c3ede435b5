from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.base import clone, is_classifier
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.utils.validation import check_is_fitted

from benchmarks.diverse_density.classifier import BagStatisticsForest, DiverseDensityClassifier
from sb3_options.density.arrays import BoolArray, FloatArray
from sb3_options.density.concepts import Plane, Point

MUSK = Path(os.environ.get("SB3_OPTIONS_MUSK1", "../shared/data/musk1.npz"))


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


def test_the_baseline_learns_from_statistics_of_bags() -> None:
    bags, labels = bags_and_labels(0, 120)
    for bag in bags[:60]:
        bag[:, 5] += 5
    probabilities = BagStatisticsForest(0).fit(bags[::2], labels[::2]).predict_proba(bags[1::2])
    assert probabilities.shape == (60, 2)
    assert np.mean((probabilities[:, 1] >= 0.5) == labels[1::2]) > 0.9


def test_labels_are_whatever_they_are() -> None:
    bags, labels = bags_and_labels(1)
    named = np.where(labels, "yes", "no")
    classifier = DiverseDensityClassifier().fit(bags, named)
    assert classifier.classes_.tolist() == ["no", "yes"]
    assert set(classifier.predict(bags)) <= {"no", "yes"}
    numbers = DiverseDensityClassifier().fit(bags, labels.astype(int))
    np.testing.assert_array_equal(numbers.predict_proba(bags), classifier.predict_proba(bags))


def test_order_of_bags_changes_little_and_units_nothing() -> None:
    bags, labels = bags_and_labels(2)
    before = DiverseDensityClassifier().fit(bags, labels).predict_proba(bags)
    order = np.random.default_rng(0).permutation(len(bags))
    shuffled = DiverseDensityClassifier().fit([bags[i] for i in order], labels[order])
    np.testing.assert_allclose(shuffled.predict_proba(bags), before, atol=0.02)
    units, zero = np.array([1e3, 1e-3, 1, 7, 1, 1]), np.array([0, 5, 1e3, 0, 0, 0])
    converted = DiverseDensityClassifier().fit([bag * units + zero for bag in bags], labels)
    np.testing.assert_allclose(converted.predict_proba([bag * units + zero for bag in bags]), before, atol=0.02)


def test_a_feature_that_never_varies_is_left_out() -> None:
    bags, labels = bags_and_labels(3)
    before = DiverseDensityClassifier().fit(bags, labels).predict_proba(bags)
    constant = [np.column_stack([bag, np.full(len(bag), 3.0)]) for bag in bags]
    after = DiverseDensityClassifier().fit(constant, labels).predict_proba(constant)
    np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("concept", [Point("one"), Plane()])
def test_other_concepts(concept: Point | Plane) -> None:
    bags, labels = bags_and_labels(4)
    assert DiverseDensityClassifier(concept, steps=50).fit(bags, labels).score(bags, labels) > 0.7


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


def test_parameters_set_after_the_fit_change_no_prediction() -> None:
    bags, labels = bags_and_labels(0)
    classifier = DiverseDensityClassifier(steps=10).fit(bags, labels)
    probabilities, predictions = classifier.predict_proba(bags), classifier.predict(bags)
    classifier.set_params(concept=Plane(), threshold=0.01)
    np.testing.assert_array_equal(classifier.predict_proba(bags), probabilities)
    np.testing.assert_array_equal(classifier.predict(bags), predictions)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"steps": 2.5}, "steps must be a whole number of at least 0, got 2.5"),
        ({"steps": -1}, "steps must be at least 1, got -1"),
        ({"threshold": np.nan}, "threshold must lie in [0, 1], got nan"),
        ({"threshold": 1.5}, "threshold must lie in [0, 1], got 1.5"),
    ],
)
def test_bad_parameters(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        DiverseDensityClassifier(**arguments).fit(*bags_and_labels(0))


@pytest.mark.parametrize(
    ("bags", "labels", "text"),
    [
        ([], [], "there are no bags"),
        ([np.zeros((1, 2)), np.zeros((0, 2))], [0, 1], "bag 1 must have shape (n >= 1, 2) like the first, got (0, 2)"),
        ([np.zeros((1, 2)), np.zeros((1, 3))], [0, 1], "bag 1 must have shape (n >= 1, 2) like the first, got (1, 3)"),
        ([np.zeros((1, 2)), np.full((1, 2), np.nan)], [0, 1], "bag 1 holds NaN"),
        ([np.zeros((1, 2))] * 2, [0], "labels must have shape (2,), one a bag, got (1,)"),
        ([np.zeros((1, 2))] * 2, [1, 1], "labels must be of two kinds, got [1]"),
        ([np.zeros((1, 2))] * 2, [0, 1], "no feature varies"),
    ],
)
def test_bad_bags(bags: list[FloatArray], labels: list[int], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        DiverseDensityClassifier().fit(bags, labels)


def test_bad_predictions() -> None:
    bags, labels = bags_and_labels(5)
    with pytest.raises(NotFittedError, match="is not fitted yet"):
        DiverseDensityClassifier().predict(bags)
    with pytest.raises(ValueError, match="bags have 2 features, fit saw 6"):
        DiverseDensityClassifier().fit(bags, labels).predict([np.zeros((1, 2))])


@pytest.mark.skipif(not MUSK.is_file(), reason=f"needs the Musk1 data at {MUSK}, or their path in SB3_OPTIONS_MUSK1")
def test_musk_in_one_split() -> None:
    data = np.load(MUSK)
    bags = [data["X"][data["bag"] == i] for i in np.unique(data["bag"])]
    labels = np.array([data["y"][data["bag"] == i].max() for i in np.unique(data["bag"])])
    classifier = DiverseDensityClassifier().fit(bags[::2], labels[::2])
    assert classifier.score(bags[1::2], labels[1::2]) > 0.7
