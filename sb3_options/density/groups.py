"""Groups of features: which of them make a concept together, whatever the others are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import field
from functools import cached_property
from typing import Annotated, TypeAlias

import numpy as np

from sb3_options.checked import Field, settings
from sb3_options.density.arrays import BoolArray, FloatArray, IntArray

Number: TypeAlias = Annotated[int, Field(ge=0)]
"""Of a feature."""


@settings
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
    """

    name: str
    features: Sequence[Number]
    present: Sequence[Sequence[Number]] = ()
    scale: Sequence[Annotated[float, Field(gt=0, allow_inf_nan=False)]] | None = None
    seen: FeatureGroup | None = None
    coordinates: Sequence[Number] = ()
    labels: Sequence[str] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        """Make the fields tuples, which compare, and refuse those that do not fit each other."""
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
        """The features that an option for a concept of this group sees."""
        return self.seen or self

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
        if len(features) == 1:  # in every step of an agent, where a call of numpy costs more than the rest
            one = features[0].tolist()
            return np.array([all(any(one[i] != 0 for i in numbers) for numbers in self.present)])
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
    """The groups themselves; a ValueError if one names an unknown feature."""
    groups = tuple(groups)
    for group in groups:
        for each in (group, group.sees):
            each.own(np.zeros((0, n_features)))
    return groups
