"""Diverse density as a classifier of bags, in the manner of scikit-learn and without needing it."""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Concept, Point
from sb3_options.density.search import ConceptSearch, instance_probabilities

CHUNK = 1 << 20
"""(instances × concepts) whose probabilities are held at once in prediction."""

REFERENCE_FEATURES = 10
"""The number of features that start scales are meant for."""


class DiverseDensityClassifier:
    """Multiple-instance classifier: a bag is positive if an instance of it lies in the concept.

    Climbs from every start and averages what the concepts at the ends say, Pr(positive) = mean over starts of
    1 − Π_j (1 − p_j). A single best concept depends much on which bags it saw; the average less so. The defaults were
    fixed on synthetic bags (docs/diverse-density.md). Features are divided by their standard deviation over all
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
        concept: Concept | None = None,
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

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The constructor's arguments, by name."""
        names = list(inspect.signature(type(self).__init__).parameters)[1:]
        return {name: getattr(self, name) for name in names}

    def set_params(self, **params: Any) -> Self:
        """Set constructor's arguments by name.

        Raises:
            ValueError: There is no such argument.
        """
        known = self.get_params()
        for name, value in params.items():
            if name not in known:
                raise ValueError(f"{type(self).__name__} has no parameter {name!r}, only {', '.join(known)}")
            setattr(self, name, value)
        return self

    def __sklearn_tags__(self) -> Any:
        """What scikit-learn, which alone calls this, wants to know before it clones, splits and scores."""
        utils = importlib.import_module("sklearn.utils")
        return utils.Tags(
            estimator_type="classifier",
            target_tags=utils.TargetTags(required=True),
            classifier_tags=utils.ClassifierTags(multi_class=False),
            input_tags=utils.InputTags(two_d_array=False),
        )

    def __sklearn_is_fitted__(self) -> bool:
        """Whether `fit` has been called."""
        return hasattr(self, "_theta")

    def fit(self, bags: Sequence[ArrayLike], labels: ArrayLike) -> Self:
        """Learn from bags of shape (n_i, d) and a label each, of two kinds; the larger is the positive one.

        Raises:
            ValueError: Bags and labels that do not fit each other, or not two kinds of labels.
        """
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
        search = ConceptSearch(
            concept=self._concept(),
            scale=1 / np.where(deviation > 0, deviation, 1),
            features=varies.tolist(),
            start_scales=[scale * math.sqrt(REFERENCE_FEATURES / len(varies)) for scale in self.start_scales],
            max_starts=self.max_starts,
        )
        packed = Bags.pack(
            [a for a, p in zip(arrays, positive, strict=True) if p],
            [a for a, p in zip(arrays, positive, strict=True) if not p],
        )
        evidence = search.evidence(packed)
        self._frame = evidence.frame
        self._theta = search.climb(evidence, self.steps)
        return self

    def predict_proba(self, bags: Sequence[ArrayLike]) -> FloatArray:
        """Probabilities of the two labels, in the order of `classes_`, shape (n_bags, 2).

        Raises:
            ValueError: Not fitted, or bags with other features.
        """
        if not hasattr(self, "_theta"):
            raise ValueError("this classifier is not fitted: call fit first")
        arrays = _checked(bags)
        if arrays[0].shape[1] != self.n_features_in_:
            raise ValueError(f"bags have {arrays[0].shape[1]} features, fit saw {self.n_features_in_}")
        positive = np.array([self._positive(bag) for bag in arrays])
        return np.column_stack([1 - positive, positive])

    def predict(self, bags: Sequence[ArrayLike]) -> NDArray[Any]:
        """The label of every bag, shape (n_bags,)."""
        positive = self.predict_proba(bags)[:, 1] >= self.threshold
        return np.asarray(self.classes_[positive.astype(int)])

    def score(self, bags: Sequence[ArrayLike], labels: ArrayLike) -> float:
        """Share of bags whose label is predicted."""
        return float(np.mean(self.predict(bags) == np.asarray(labels)))

    def _concept(self) -> Concept:
        return (
            Point(scale_bounds=(0, math.inf), prior="small", prior_width=0.5) if self.concept is None else self.concept
        )

    def _positive(self, bag: FloatArray) -> float:
        scaled = (bag[:, self._frame.features] - self._frame.origin) * self._frame.scale
        none = np.ones(self._theta.shape[1])
        for part in np.array_split(scaled, -(-scaled.size // CHUNK)):
            none *= (1 - instance_probabilities(self._concept(), self._theta, part)).prod(0)
        return float(1 - none.mean())


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
