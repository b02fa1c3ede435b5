"""Checks of arguments that several parts of this folder share."""

from __future__ import annotations

import numpy as np

from sb3_options.density.arrays import FloatArray

LARGEST_FEATURE, LARGEST_SCALE = 1e100, 1e50
"""Their product squared is still a number."""


def whole(value: object, least: int) -> bool:
    """Whether this is a whole number of at least ``least``."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and int(value) >= least


def positive_scale(scale: object) -> bool:
    """Whether this is a scale: positive and finite, a number or (d,)."""
    array = np.asarray(scale, dtype=np.float64)
    return array.ndim < 2 and bool(((array > 0) & (array <= LARGEST_SCALE)).all())


def refuse(settings: object, **checks: tuple[str, bool]) -> None:
    """Raise `ValueError` for the first setting that is not what is expected of it."""
    for name, (expected, holds) in checks.items():
        if not holds:
            raise ValueError(f"{name} must be {expected}, got {getattr(settings, name)!r}")


def check_finite(name: str, features: FloatArray) -> None:
    """Raise `ValueError` for NaN, infinite features, and those whose squares overflow."""
    if not np.isfinite(features).all():
        raise ValueError(f"{name} holds NaN or infinite features")
    if np.abs(features).max(initial=0) > LARGEST_FEATURE:
        raise ValueError(f"{name} holds features beyond ±{LARGEST_FEATURE:g}, whose squares overflow")
