"""Checks of constructor arguments that environments share."""

import math
from numbers import Real
from operator import index

__all__ = ["count", "flag", "number", "one_of", "step_limit"]


def number(value: float, argument: str, low: float = -math.inf, high: float = math.inf) -> float:
    """The value as a float, if it is finite and in ``low..high``.

    Raises:
        TypeError: It is no number.
        ValueError: It is out of its range.
    """
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
    """The value as an int, if it is at least ``low``.

    Raises:
        TypeError: It is no integer.
        ValueError: It is too small.
    """
    try:
        number = index(value)
    except TypeError:
        raise TypeError(f"{argument} must be an integer, got {value!r}") from None
    if number < low:
        raise ValueError(f"{argument} must be at least {low}, got {number}")
    return number


def flag(value: bool, argument: str) -> bool:
    """The value, if it is True or False.

    Raises:
        TypeError: It is neither.
    """
    if not isinstance(value, bool):
        raise TypeError(f"{argument} must be True or False, got {value!r}")
    return value


def step_limit(value: int | None) -> int | None:
    """The value as an int >= 1, or None.

    Raises:
        TypeError: It is neither an integer nor None.
        ValueError: It is less than 1.
    """
    if value is None:
        return None
    try:
        limit = index(value)
    except TypeError:
        raise TypeError(f"max_steps must be an integer or None, got {value!r}") from None
    if limit < 1:
        raise ValueError(f"max_steps must be at least 1, or None for no limit, got {limit}")
    return limit


def one_of(value: str, allowed: tuple[str, ...], argument: str) -> str:
    """The value, if it is allowed.

    Raises:
        ValueError: It is not.
    """
    if value not in allowed:
        raise ValueError(f"{argument} must be one of {', '.join(map(repr, allowed))}, got {value!r}")
    return value
