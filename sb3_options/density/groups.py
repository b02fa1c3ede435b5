"""Groups of features: which of them make a concept together, whatever the others are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from sb3_options.density.arrays import BoolArray, FloatArray, IntArray
from sb3_options.state import storable


@storable
@dataclass(frozen=True)
class FeatureGroup:
    """Features of concept space that make a concept together (the subsets of McGovern & Barto 2001, §7 and §8).

    A concept of the group says nothing of the other features: "a closed door straight ahead, whatever else".

    Attributes:
        name: For people.
        features: Numbers of the group's own features among all of φ, k of them.
        present: Sets of these numbers. Where all features of one set are 0, what the group is about is not there: that
            is no place, neither a subgoal nor in an initiation set. By default every state is one.
        scale: Factor for each of its own features before distances are taken, (k,); None for 1.
        seen: Features that an option for a concept of this group sees: its initiation set lies in them, and its policy
            acts on them. A group that begins with this one's features, or a mapping of its fields; None for this group
            itself. With more features the option can begin where what it is about is not in view yet, and go around
            what is in the way.
        coordinates: Numbers of those of its features that say where a thing is, so that an action displaces them by the
            same vector wherever it is: from steps near a thing an option then learns those farther away
            (`options.imagined`). By default none.
        labels: What its own features are called where a concept is told to people, k texts, empty for what goes without
            saying; by default numbers alone are told. Groups that differ in nothing else are equal.

    Raises:
        ValueError: An argument is out of its range.
    """

    name: str
    features: Sequence[int]
    present: Sequence[Sequence[int]] = ()
    scale: Sequence[float] | None = None
    seen: FeatureGroup | Mapping[str, Any] | None = None
    coordinates: Sequence[int] = ()
    labels: Sequence[str] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        """Refuse arguments out of range, and make them tuples, which compare."""
        try:
            features = tuple(map(int, self.features))
            present = tuple(tuple(map(int, numbers)) for numbers in self.present)
            scale = (1.0,) * len(features) if self.scale is None else tuple(map(float, self.scale))
            coordinates = tuple(map(int, self.coordinates))
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(
                f"group {self.name!r}: features must be numbers from 0, present sets of these, coordinates some of "
                f"them, and scale a number for each or None, got {self.features!r}, {self.present!r}, "
                f"{self.coordinates!r} and {self.scale!r}"
            ) from error
        if not features or len(set(features)) < len(features) or min(features) < 0:
            raise ValueError(f"group {self.name!r}: features must be distinct numbers from 0, at least one: {features}")
        if not all(numbers and set(numbers) <= set(features) for numbers in present):
            raise ValueError(f"group {self.name!r}: present must be sets of its features {features}, got {present}")
        if not set(coordinates) <= set(features):
            raise ValueError(f"group {self.name!r}: coordinates must be of its features {features}, got {coordinates}")
        if len(scale) != len(features) or not (np.isfinite(scale).all() and min(scale) > 0):
            raise ValueError(f"group {self.name!r}: scale must be {len(features)} numbers above 0, got {scale}")
        for name, value in (("features", features), ("present", present), ("scale", scale), ("seen", self._seen())):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "coordinates", coordinates)
        object.__setattr__(self, "labels", self._labels())

    def _labels(self) -> tuple[str, ...]:
        labels = tuple(self.labels) if isinstance(self.labels, list | tuple) else (self.labels,)
        if labels and not (len(labels) == len(self.features) and all(isinstance(label, str) for label in labels)):
            raise ValueError(f"group {self.name!r}: labels must be {len(self.features)} texts, got {self.labels!r}")
        return labels

    def _seen(self) -> FeatureGroup | None:
        seen, features = self.seen, tuple(map(int, self.features))
        if isinstance(seen, Mapping):
            try:
                seen = FeatureGroup(**seen)
            except TypeError as error:
                raise ValueError(f"group {self.name!r}: seen must have the fields of a group: {error}") from error
        if seen is not None and (not isinstance(seen, FeatureGroup) or seen.seen is not None):
            raise ValueError(f"group {self.name!r}: seen must be a group that has no other one to see, got {seen!r}")
        if seen is not None and seen.features[: len(features)] != features:
            raise ValueError(f"group {self.name!r}: seen must begin with its features {features}, got {seen.features}")
        return seen

    @property
    def sees(self) -> FeatureGroup:
        """The features that an option for a concept of this group sees."""
        return self if not isinstance(self.seen, FeatureGroup) else self.seen

    def own(self, features: FloatArray) -> FloatArray:
        """The group's own features (batch, k) of all features (batch, d)."""
        if self._last >= features.shape[1]:
            raise ValueError(
                f"group {self.name!r} names feature {self._last}, the feature map gives {features.shape[1]}"
            )
        return features.take(self._columns, axis=1)

    def told(self, point: FloatArray) -> str | None:
        """A point (k,) by the labels of its features, for people; None if they have none."""
        if not self.labels:
            return None
        said = ", ".join(f"{label} {x:g}" for label, x in zip(self.labels, point.tolist(), strict=True) if label)
        return f"{self.name} at {said}" if said else self.name

    def is_place(self, features: FloatArray) -> BoolArray:
        """Whether what the group is about is there, for features (batch, d), shape (batch,)."""
        there = np.ones(len(features), dtype=bool)
        for columns in self._present_columns:
            there &= (features.take(columns, axis=1) != 0).any(axis=1)
        return there

    @cached_property
    def _columns(self) -> IntArray:
        return np.array(self.features)

    @cached_property
    def _last(self) -> int:
        return max(self.features)

    @cached_property
    def _present_columns(self) -> list[IntArray]:
        return [np.array(numbers) for numbers in self.present]


def checked_groups(groups: Iterable[FeatureGroup], n_features: int) -> tuple[FeatureGroup, ...]:
    """The groups themselves; a ValueError if one names an unknown feature, or two have the same name."""
    groups = tuple(groups)
    for group in groups:
        for each in (group, group.sees):
            each.own(np.zeros((0, n_features)))
    names = [group.name for group in groups]
    if len(set(names)) < len(names):
        raise ValueError(f"two groups of features have the same name: {sorted(names)}")
    return groups
