"""Regions of concept space: unions of balls, and half-spaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.density.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class Region:
    """A union of balls of one radius in concept space: a subgoal (one ball) or an initiation set (many).

    Attributes:
        points: Centres, shape (n, d).
        scale: Factor for every feature before distances are taken, shape (d,).
        radius: In scaled units, ≥ 0.
    """

    points: FloatArray
    scale: FloatArray
    radius: float

    def contains(self, features: FloatArray) -> BoolArray:
        """Whether min over centres of ‖scale · (feature − centre)‖ ≤ radius, shape (batch,)."""
        if len(self.points) == 0:
            return np.zeros(len(features), dtype=bool)
        nearest: FloatArray = cdist(features * self.scale, self.points * self.scale).min(axis=1)
        return nearest <= self.radius


@dataclass(frozen=True)
class HalfSpace(Region):
    """One side of a plane in concept space, ``points`` being one point of the plane.

    Attributes:
        normal: (d,), at right angles to the plane, towards the side that is meant; 0 for features of no importance.
    """

    normal: FloatArray

    def contains(self, features: FloatArray) -> BoolArray:
        """Whether normal · (feature − point) ≥ 0, shape (batch,)."""
        inside: BoolArray = (features - self.points[0]) @ self.normal >= 0
        return inside
