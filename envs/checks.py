"""Checks of constructor arguments that environments share."""

import math
from numbers import Real
from operator import index
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray


def number(value: float, argument: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return the value as a float, if it is finite and in ``low..high``."""
    if not isinstance(value, Real):
        raise TypeError(f"{argument} must be a number, got {value!r}")
    if not (math.isfinite(value) and low <= value <= high):
        if math.isinf(low):
            bounds = "finite"
        else:
            bounds = f"finite and at least {low}" if math.isinf(high) else f"in {low}..{high}"
        raise ValueError(f"{argument} must be {bounds}, got {value!r}")
    return float(value)


def count(value: int, argument: str, low: int) -> int:
    """Return the value as an int, if it is at least ``low``."""
    try:
        number = index(value)
    except TypeError:
        raise TypeError(f"{argument} must be an integer, got {value!r}") from None
    if number < low:
        raise ValueError(f"{argument} must be at least {low}, got {number}")
    return number


def batch(observations: NDArray[Any], space: spaces.Space[Any]) -> NDArray[Any]:
    """Return the observations as an array, if they are a batch of the space's."""
    observations = np.asarray(observations)
    if observations.ndim == 0 or observations.shape[1:] != space.shape:
        raise ValueError(
            f"observations must be a batch of observations of shape {space.shape} each, got shape {observations.shape}"
        )
    return observations


def step_limit(value: int | None) -> int | None:
    """Return the value as an int >= 1, or None."""
    return None if value is None else count(value, "max_steps", low=1)


def one_of(value: str, allowed: tuple[str, ...], argument: str) -> str:
    """Return the value, if it is allowed."""
    if value not in allowed:
        raise ValueError(f"{argument} must be one of {', '.join(map(repr, allowed))}, got {value!r}")
    return value
