"""Checks of arguments that several parts of this folder share."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sb3_options.density.arrays import FloatArray

LARGEST_FEATURE, LARGEST_SCALE = 1e100, 1e50
"""Their product squared is still a number."""


def positive_scale(scale: object) -> bool:
    """Whether this is a scale: positive and finite, a number or (d,)."""
    array = np.asarray(scale)
    if array.dtype.kind not in "iuf":
        return False
    array = array.astype(np.float64)
    return array.ndim < 2 and bool(((array > 0) & (array <= LARGEST_SCALE)).all())


def refuse(settings: object, **checks: tuple[str, bool]) -> None:
    """Raise `ValueError` for the first setting out of range."""
    for name, (expected, holds) in checks.items():
        if not holds:
            raise ValueError(f"{name} must be {expected}, got {getattr(settings, name)!r}")


def real_array(name: str, values: ArrayLike) -> FloatArray:
    """Real numbers as an array in double precision.

    Raises:
        ValueError: They are complex, masked, ragged or no numbers at all, of which a part would be dropped in silence.
    """
    if np.ma.is_masked(values):
        raise ValueError(f"{name} has masked values: leave out the instances that hold them, or fill them in")
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name} must hold instances of one length: {error}") from error
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} must hold real numbers, got {array.dtype}")
    return array.astype(np.float64)


def check_finite(name: str, features: FloatArray) -> None:
    """Raise `ValueError` for NaN, infinite features, and those whose squares overflow."""
    if not np.isfinite(features).all():
        raise ValueError(f"{name} holds NaN or infinite features")
    if np.abs(features).max(initial=0) > LARGEST_FEATURE:
        raise ValueError(f"{name} holds features beyond ±{LARGEST_FEATURE:g}, whose squares overflow")
