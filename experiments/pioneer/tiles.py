"""Binary features of the robot's senses for `MacroQ`: tile coding (CMAC)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_options.experience.observations import FloatArray, IntArray
from sb3_options.learning.macro_q import LinearFeatures


class TileCoding:
    """Tile coding, or CMAC (Albus 1975; Sutton & Barto 2018, §9.5.4): several grids, each shifted a little.

    Tiling i is shifted along dimension k by (i · (2k + 1) mod n) / n of a tile, n the number of tilings: the
    displacement vector of the first odd integers, which Miller & Glanz (1996) recommend and Sutton & Barto (2018,
    §9.5.4, p. 219) repeat, with n a power of two and at least four times the number of dimensions.

    Args:
        low: Lower bounds of the observation, shape (d,). What lies beyond a bound falls into the tile at the bound.
        high: Upper bounds, > low, shape (d,).
        tiles: Tiles along each dimension within the bounds, at least 1 each, shape (d,).
        n_tilings: Number of tilings, at least 1.
    """

    def __init__(
        self,
        low: npt.ArrayLike,
        high: npt.ArrayLike,
        tiles: Sequence[int],
        *,
        n_tilings: int = 8,
    ) -> None:
        self.low = np.asarray(low, dtype=np.float64)
        self.high = np.asarray(high, dtype=np.float64)
        self.tiles = np.asarray(tiles, dtype=np.int64)
        self.n_active = n_tilings
        dimension, tiling = np.arange(len(self.low)), np.arange(n_tilings)[:, None]
        self._offsets: FloatArray = (tiling * (2 * dimension + 1)) % n_tilings / n_tilings
        # A shifted grid needs one tile more to cover the upper bound.
        self._cells = self.tiles + 1
        self._strides = np.append(np.cumprod(self._cells[::-1])[::-1][1:], 1)
        per_tiling = int(np.prod(self._cells))
        self._first = np.arange(n_tilings) * per_tiling
        self.n_features = n_tilings * per_tiling

    def active(self, observations: npt.NDArray[Any]) -> IntArray:
        """The tile of each tiling, shape (batch, n_tilings)."""
        unit = (observations.reshape(-1, len(self.low)) - self.low) / (self.high - self.low)
        place = np.clip(unit, 0.0, 1.0)[:, None, :] * self.tiles + self._offsets
        cell = np.minimum(place.astype(np.int64), self._cells - 1)
        index: IntArray = cell @ self._strides + self._first
        return index


class Concatenated:
    """Several feature sets side by side, each over some of the observation's numbers.

    A tile coding of all numbers at once needs tiles for every combination. One tile coding per group of numbers needs
    far fewer, and the value is then a sum of functions of the groups (Sutton & Barto 2018, §9.5.4).

    Args:
        parts: Pairs of the numbers' indices in the flat observation, and features of these numbers.
    """

    def __init__(self, parts: Sequence[tuple[Sequence[int], LinearFeatures]]) -> None:
        self.parts = [(np.asarray(columns, dtype=np.int64), features) for columns, features in parts]
        sizes = [features.n_features for _, features in self.parts]
        self.n_features = sum(sizes)
        self.n_active = sum(features.n_active for _, features in self.parts)
        self._first = [sum(sizes[:i]) for i in range(len(sizes))]

    def active(self, observations: npt.NDArray[Any]) -> IntArray:
        """Those of all parts, one after another, shape (batch, n_active)."""
        flat = observations.reshape(len(observations), -1)
        found = [
            features.active(flat[:, columns]) + first
            for (columns, features), first in zip(self.parts, self._first, strict=True)
        ]
        return np.concatenate(found, axis=1)
