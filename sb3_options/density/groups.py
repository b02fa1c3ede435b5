"""Groups of features that make a concept together, whatever the other features are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import field
from functools import cached_property
from typing import Annotated, TypeAlias

import numpy as np

from sb3_options.checked import Field, settings
from sb3_options.density.arrays import BoolArray, FloatArray, IntArray

Number: TypeAlias = Annotated[int, Field(ge=0)]  # index of a feature


@settings
class FeatureGroup:
    """Features of concept space that make a concept together (the subsets of McGovern & Barto 2001, §7 and §8).

    A concept of the group leaves all other features open: "a closed door straight ahead, whatever else".

    Attributes:
        name: Name for people.
        features: Indices of the group's k own features in φ.
        present: Sets of these indices. If all features of a set are 0, the group's thing is absent. Such a state is no
            place, neither a subgoal nor in an initiation set. By default every state is a place.
        scale: Factor for each own feature before distances are taken, (k,); None for 1.
        seen: Features that an option of this group sees, in its initiation set and its policy. A group that begins
            with this group's features, or a mapping of its fields; None for this group itself. With more features the
            option can begin before its thing is in view, and avoid obstacles.
        coordinates: Indices of own features that locate a thing, so that an action displaces them by the same vector
            everywhere. From steps near a thing an option then learns steps farther away (`options.imagined`). By
            default none.
        labels: Names of own features in descriptions, k texts, empty for a feature that is left out. By default only
            numbers are shown. Groups that differ only in labels are equal.
    """

    name: str
    features: Sequence[Number]
    present: Sequence[Sequence[Number]] = ()
    scale: Sequence[Annotated[float, Field(gt=0, allow_inf_nan=False)]] | None = None
    seen: FeatureGroup | None = None
    coordinates: Sequence[Number] = ()
    labels: Sequence[str] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        """Turn the fields into tuples, which can be compared, and refuse inconsistent fields."""
        k = len(self.features)
        own = set(self.features)
        tuples = {name: tuple(getattr(self, name)) for name in ("features", "coordinates", "labels")}
        tuples["present"] = tuple(map(tuple, self.present))
        tuples["scale"] = (1.0,) * k if self.scale is None else tuple(self.scale)
        for name, value in tuples.items():
            object.__setattr__(self, name, value)
        seen = self.seen
        fits = {
            "features must be distinct numbers, at least one": k == len(own) > 0,
            "present must be sets of its features": all(numbers and set(numbers) <= own for numbers in self.present),
            "coordinates must be some of its features": set(self.coordinates) <= own,
            f"scale must be {k} numbers": len(tuples["scale"]) == k,
            f"labels must be {k} texts": len(self.labels) in (0, k),
            "seen must begin with its features, and see no other group": seen is None
            or (seen.seen is None and seen.features[:k] == self.features),
        }
        for expected, holds in fits.items():
            if not holds:
                raise ValueError(f"group {self.name!r}: {expected}")

    @property
    def sees(self) -> FeatureGroup:
        """The features that an option of this group sees."""
        return self.seen or self

    def own(self, features: FloatArray) -> FloatArray:
        """Return the group's own features (batch, k) from all features (batch, d)."""
        self._check_width(features.shape[1])
        return features.take(self._columns, axis=1)

    def own_of_one(self, features: list[float]) -> list[float]:
        """Return the group's own features of one row."""
        self._check_width(len(features))
        return [features[number] for number in self.features]

    def _check_width(self, d: int) -> None:
        if self._last >= d:
            raise ValueError(f"group {self.name!r} names feature {self._last}, the feature map gives {d}")

    def told(self, point: FloatArray) -> str | None:
        """Describe a point (k,) by the labels of its features; None without labels."""
        if not self.labels:
            return None
        said = ", ".join(f"{label} {x:g}" for label, x in zip(self.labels, point.tolist(), strict=True) if label)
        return f"{self.name} at {said}" if said else self.name

    def is_place(self, features: FloatArray) -> BoolArray:
        """Whether the group's thing is present, for features (batch, d), shape (batch,)."""
        there = np.ones(len(features), dtype=bool)
        for columns in self._present_columns:
            there &= (features.take(columns, axis=1) != 0).any(axis=1)
        return there

    def holds(self, features: list[float]) -> bool:
        """`is_place` for one row."""
        return all(any(features[number] != 0 for number in numbers) for numbers in self.present)

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
    """Return the groups; raise ValueError if one names an unknown feature."""
    groups = tuple(groups)
    for group in groups:
        for each in (group, group.sees):
            each.own(np.zeros((0, n_features)))
    return groups
