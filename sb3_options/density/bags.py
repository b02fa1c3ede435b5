"""Bags of instances."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from sb3_options.density.arrays import BoolArray, FloatArray, IntArray, row_keys
from sb3_options.density.layout import BagArrays, Segment, segments_of
from sb3_options.state import storable

LARGEST_FEATURE, LARGEST_SCALE = 1e100, 1e50  # the square of their product is still finite


@storable
@dataclass(frozen=True, eq=False)
class Bags:
    """Bags of instances, packed once by :meth:`pack` and searched many times.

    Attributes:
        instances: (N, d) in float64, bag after bag, positive bags first.
        lengths: Number of instances in each bag.
        n_positive: Number of positive bags.
    """

    instances: Tensor
    lengths: tuple[int, ...]
    n_positive: int

    @classmethod
    def pack(cls, positive: Sequence[ArrayLike], negative: Sequence[ArrayLike] = ()) -> Self:
        """Pack bags of shape (n_i, d). An instance given twice counts twice: pass first visits only.

        Raises:
            ValueError: No bag, an empty bag, bags with different d, or features that are not real numbers, NaN,
                infinite, masked or too large to square.
        """
        names = [f"positive bag {i}" for i in range(len(positive))]
        names += [f"negative bag {i}" for i in range(len(negative))]
        if not names:
            raise ValueError("there are no bags: pass at least one positive or negative bag")
        arrays = [_real(name, bag) for name, bag in zip(names, (*positive, *negative), strict=True)]
        for name, array in zip(names, arrays, strict=True):
            if array.ndim != 2 or array.size == 0 or array.shape[1:] != arrays[0].shape[1:]:
                raise ValueError(
                    f"{name} must have shape (instances, features), at least one of each and as many features as "
                    f"{names[0]}, {arrays[0].shape}, got {array.shape}"
                )
        instances = np.concatenate(arrays, dtype=np.float64)
        if not all_finite(instances):  # checked at once: there may be a thousand bags
            for name, array in zip(names, arrays, strict=True):
                check_finite(name, array)
        return cls(torch.from_numpy(instances), tuple(map(len, arrays)), len(positive))

    @property
    def n_features(self) -> int:
        """The dimension d of the feature space."""
        return int(self.instances.shape[1])

    def smallest_positive(self, n: int) -> FloatArray:
        """Return the distinct instances (m, d) of the `n` smallest positive bags, in packing order."""
        positive = torch.split(self.instances, list(self.lengths))[: self.n_positive]
        smallest = sorted(sorted(range(len(positive)), key=lambda i: self.lengths[i])[:n])
        return distinct(torch.cat([self.instances[:0], *(positive[i] for i in smallest)]).numpy())

    def arrays(self, transform: Callable[[FloatArray], FloatArray]) -> BagArrays:
        """Return the bags as arrays, with transformed instances."""
        positive = np.arange(len(self.lengths)) < self.n_positive
        return BagArrays(transform(self.instances.numpy()), np.array(self.lengths), positive)

    @cached_property
    def origin(self) -> Tensor:
        """The origin (d,) of features, so that an offset common to all instances costs no digits.

        If all values of a feature lie within a factor of two, it is the first instance, and every difference is exact
        (Sterbenz 1974). Other features spread as widely as their offset, and have origin 0.
        """
        low, high = self.instances.abs().aminmax(dim=0)
        one_sign = (self.instances > 0).all(0) | (self.instances < 0).all(0)
        return torch.where(one_sign & (high <= 2 * low), self.instances[0], 0)

    @cached_property
    def segments(self) -> list[Segment]:
        """The bags relative to the `origin`, in double precision, in the kernels' layout; packed once."""
        origin = self.origin.numpy()
        return segments_of(self.arrays(lambda instances: instances - origin), torch.float64)


def distinct(points: FloatArray) -> FloatArray:
    """Drop repeated rows, keeping the order."""
    return points[first_rows(points)]


def held_by_all(points: FloatArray, bags: Sequence[FloatArray]) -> BoolArray:
    """Which points (m, d) are an instance of every bag (n_i, d), of at least one: (m,)."""
    shared = set.intersection(*(set(row_keys(bag)) for bag in bags))
    return np.array([key in shared for key in row_keys(points)], dtype=np.bool_)


def first_rows(points: FloatArray) -> IntArray:
    """Return the indices of rows (n, d) that equal no earlier row."""
    first: dict[bytes, int] = {}
    for i, key in enumerate(row_keys(points)):
        first.setdefault(key, i)
    return np.fromiter(first.values(), dtype=np.int64, count=len(first))


def real_array(name: str, values: ArrayLike) -> FloatArray:
    """Convert to double precision. Refuse masked or complex values, which would silently lose information."""
    return _real(name, values).astype(np.float64)


def _real(name: str, values: ArrayLike) -> NDArray[Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "biuf" or np.ma.is_masked(values):
        raise ValueError(f"{name} must hold real numbers, none of them masked, got {array.dtype}")
    return array


def check_finite(name: str, features: FloatArray) -> None:
    """Refuse NaN, infinite features, and features whose squares overflow."""
    if not all_finite(features):
        raise ValueError(f"{name} holds NaN, or features beyond ±{LARGEST_FEATURE:g}, whose squares overflow")


def all_finite(features: FloatArray) -> bool:
    """Whether no feature is NaN, infinite, or too large to square."""
    return bool(features.max(initial=0) <= LARGEST_FEATURE and features.min(initial=0) >= -LARGEST_FEATURE)


def positive_scale(scale: object) -> bool:
    """Whether a scale is valid: positive and finite, a number or (d,)."""
    array = np.asarray(scale)
    if array.dtype.kind not in "iuf" or array.ndim > 1:
        return False
    array = array.astype(np.float64)
    return bool(((array > 0) & (array <= LARGEST_SCALE)).all())
