"""Bags that the benchmarks and the study of diverse density use: Musk1, and synthetic ones."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_options.density.arrays import BoolArray, FloatArray


class LabelledBags(NamedTuple):
    """Bags (n_i, d), and whether each is positive."""

    bags: list[FloatArray]
    labels: BoolArray

    @property
    def positive(self) -> list[FloatArray]:
        """The positive bags."""
        return [bag for bag, label in zip(self.bags, self.labels, strict=True) if label]

    @property
    def negative(self) -> list[FloatArray]:
        """The negative bags."""
        return [bag for bag, label in zip(self.bags, self.labels, strict=True) if not label]

    def standardised(self) -> LabelledBags:
        """With mean 0 and standard deviation 1 of every feature over all instances."""
        x = np.concatenate(self.bags)
        return LabelledBags([(bag - x.mean(0)) / x.std(0) for bag in self.bags], self.labels)


def musk1(path: Path) -> LabelledBags:
    """Musk1 (Dietterich, Lathrop & Lozano-Pérez 1997): 92 bags, 476 instances, 166 features.

    Args:
        path: An .npz with X (476, 166), y and bag (476,).
    """
    data = np.load(path)
    numbers = np.unique(data["bag"])
    bags = [np.asarray(data["X"][data["bag"] == i], dtype=np.float64) for i in numbers]
    return LabelledBags(bags, np.array([data["y"][data["bag"] == i].max() > 0 for i in numbers]))


def uneven(rng: np.random.Generator, d: int, n_bags: int = 180, shortest: int = 20, longest: int = 60) -> LabelledBags:
    """Standard normal bags of uneven length, half of them positive."""
    bags = [rng.normal(size=(int(rng.integers(shortest, longest + 1)), d)) for _ in range(n_bags)]
    return LabelledBags(bags, np.arange(n_bags) < n_bags // 2)


def planted(rng: np.random.Generator, n_bags: int, n_instances: int, reach: float = 20.0) -> list[FloatArray]:
    """Noise over a square of side 2 ``reach``, with one instance a bag around a place common to all."""
    place = np.array([3.0, -2.0])
    return [
        np.vstack([rng.uniform(-reach, reach, (n_instances - 1, 2)), rng.normal(place, 0.3)]) for _ in range(n_bags)
    ]
