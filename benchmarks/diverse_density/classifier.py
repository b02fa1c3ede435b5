"""Diverse density as a classifier of bags, an estimator of scikit-learn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.ensemble import RandomForestClassifier
from sklearn.utils.validation import check_is_fitted

from benchmarks.diverse_density.scales import FewFeatures, FromScales
from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Point

CHUNK = 1 << 20
"""(instances × concepts) whose probabilities are held at once in prediction."""

REFERENCE_FEATURES = 10
"""The number of features that start scales are meant for."""


class DiverseDensityClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """Multiple-instance classifier: a bag is positive if an instance of it lies in the concept.

    Climbs from every start and averages what the concepts at the ends say, Pr(positive) = mean over starts of
    1 − Π_j (1 − p_j). A single best concept depends much on which bags it saw; the average less so. The defaults were
    fixed on synthetic bags (docs/studies/density.md). Features are divided by their standard deviation over all
    training instances; those that do not vary are left out.

    Args:
        concept: Class of concepts; by default a point with a scale per feature and no bounds but a prior.
        start_scales: Scales of the starts, as one over standard deviations, for `REFERENCE_FEATURES` features; with
            others they are multiplied by √(REFERENCE_FEATURES / features), which keeps distances what they are.
        max_starts: Most points to start from, evenly spaced among the instances of positive bags; None for all.
        steps: Evaluations of the objective that each start may climb. Few: climbing on, the starts run together in
            one concept that fits the training bags ever better and new ones worse.
        threshold: `predict` says 1 for a probability of at least this.

    Attributes:
        classes_: The two labels, the positive one last; set by `fit`.
        n_features_in_: Features of the training instances.
    """

    def __init__(
        self,
        concept: Point | None = None,
        *,
        start_scales: Sequence[float] = (0.25, 0.5),
        max_starts: int | None = None,
        steps: int = 20,
        threshold: float = 0.5,
    ) -> None:
        self.concept = concept
        self.start_scales = start_scales
        self.max_starts = max_starts
        self.steps = steps
        self.threshold = threshold

    def __sklearn_tags__(self) -> Any:
        """Bags are lists of arrays, and there are two kinds of labels."""
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        tags.classifier_tags.multi_class = False
        return tags

    def fit(self, bags: Sequence[ArrayLike], labels: ArrayLike) -> Self:
        """Learn from bags of shape (n_i, d) and a label each, of two kinds; the larger is the positive one.

        What is predicted afterwards depends on the parameters as they are now, not on later ones.

        Raises:
            ValueError: A parameter out of its range, bags and labels that do not fit each other, or not two kinds of
                labels.
        """
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, got {self.steps}")
        if not 0 <= self.threshold <= 1:
            raise ValueError(f"threshold must lie in [0, 1], got {self.threshold}")
        arrays = _checked(bags)
        y = np.asarray(labels)
        if y.shape != (len(arrays),):
            raise ValueError(f"labels must have shape ({len(arrays)},), one a bag, got {y.shape}")
        self.classes_ = np.unique(y)
        if len(self.classes_) != 2:
            raise ValueError(f"labels must be of two kinds, got {self.classes_.tolist()}")
        positive = y == self.classes_[1]
        self.n_features_in_ = arrays[0].shape[1]
        deviation = np.concatenate(arrays).std(axis=0)
        varies = np.flatnonzero(deviation > 0)
        if not len(varies):
            raise ValueError("no feature varies: there is nothing to learn from")
        self._concept: Point = self.concept or FewFeatures(scale_bounds=(0, math.inf))
        search = FromScales(
            concept=self._concept,
            method="thorough",
            scale=1 / deviation[varies],
            start_scales=[scale * math.sqrt(REFERENCE_FEATURES / len(varies)) for scale in self.start_scales],
            max_starts=self.max_starts,
        )
        packed = Bags.pack(
            [a[:, varies] for a, p in zip(arrays, positive, strict=True) if p],
            [a[:, varies] for a, p in zip(arrays, positive, strict=True) if not p],
        )
        evidence = search.evidence(packed)
        self._varies, self._threshold = varies, self.threshold
        self._origin, self._scale = evidence.origin, evidence.scale
        descent = search.descent(search.starts(evidence).float(), evidence)
        descent.run(self.steps)  # no start is dropped, and none merged
        self._theta = self._concept.canonical(descent.theta.double()).numpy()
        return self

    def predict_proba(self, bags: Sequence[ArrayLike]) -> FloatArray:
        """Probabilities of the two labels, in the order of `classes_`, shape (n_bags, 2).

        Raises:
            NotFittedError: `fit` was not called.
            ValueError: Bags with other features.
        """
        check_is_fitted(self)
        arrays = _checked(bags)
        if arrays[0].shape[1] != self.n_features_in_:
            raise ValueError(f"bags have {arrays[0].shape[1]} features, fit saw {self.n_features_in_}")
        positive = np.array([self._positive(bag) for bag in arrays])
        return np.column_stack([1 - positive, positive])

    def predict(self, bags: Sequence[ArrayLike]) -> NDArray[Any]:
        """The label of every bag, shape (n_bags,)."""
        positive = self.predict_proba(bags)[:, 1] >= self._threshold
        return np.asarray(self.classes_[positive.astype(int)])

    def _positive(self, bag: FloatArray) -> float:
        scaled = (bag[:, self._varies] - self._origin) * self._scale
        coefficients = self._concept.coefficients(torch.from_numpy(self._theta)).numpy()
        none = np.ones(self._theta.shape[1])
        for part in np.array_split(scaled, -(-scaled.size // CHUNK)):
            powers = np.concatenate([np.ones((len(part), 1)), part, part**2], axis=1)
            none *= (1 - np.exp(-np.maximum(powers @ coefficients, 0))).prod(0)
        return float(1 - none.mean())


class BagStatisticsForest:
    """A baseline that knows no instances: mean, minimum and maximum of every feature over the bag, a random forest.

    Args:
        seed: Of the forest.
    """

    def __init__(self, seed: int) -> None:
        self._forest = RandomForestClassifier(500, random_state=seed)

    def fit(self, bags: Sequence[FloatArray], labels: ArrayLike) -> Self:
        """Learn from bags (n_i, d) and their labels."""
        self._forest.fit(self._statistics(bags), labels)
        return self

    def predict_proba(self, bags: Sequence[FloatArray]) -> FloatArray:
        """Probabilities of the two labels, shape (n_bags, 2)."""
        return np.asarray(self._forest.predict_proba(self._statistics(bags)))

    def _statistics(self, bags: Sequence[FloatArray]) -> FloatArray:
        return np.array([np.concatenate([bag.mean(0), bag.min(0), bag.max(0)]) for bag in bags])


def _checked(bags: Sequence[ArrayLike]) -> list[FloatArray]:
    arrays = [np.asarray(bag, dtype=np.float64) for bag in bags]
    if not arrays:
        raise ValueError("there are no bags: pass at least one")
    d = arrays[0].shape[-1] if arrays[0].ndim else 0
    for i, array in enumerate(arrays):
        if array.ndim != 2 or not array.size or array.shape[1] != d:
            raise ValueError(f"bag {i} must have shape (n >= 1, {d}) like the first, got {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"bag {i} holds NaN or infinite features")
    return arrays
