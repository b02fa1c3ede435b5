"""`OptionRun`: which action `OptionsWrapper.step` ran, for how long, and how it ended."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations

Termination: TypeAlias = Literal[
    "primitive", "subgoal", "left_initiation", "max_duration", "terminated", "truncated", "running"
]
"""Why a run ended; "running": it has not ended, or must not be learned from (`OptionsVecEnv`)."""


class OptionRun(NamedTuple):
    """One action of a semi-Markov decision process: a primitive step, or an option from its start to its end.

    ``info["option"]`` holds it as a dict, which travels between processes and needs no import: `as_info` writes it,
    `from_info` reads it.

    Attributes:
        index: Slot of the option that ran; -1 for a primitive.
        duration: Primitive steps k; 0 while an option of `OptionsVecEnv` goes on.
        discount: γᵏ.
        gamma: γ per primitive step.
        termination: Why the run ended.
        observations: For an option: the k observations in which it acted.
        actions: For an option: its primitive actions, (k,). For a slot that ran a primitive instead: that one, (1,).
        rewards: For an option: the undiscounted rewards of its primitive steps, (k,).
        available: Which slots may start in each of the k observations arrived in, (k, max_options); None without
            options, or without ``SlotState.report_availability``.
        inside: For an option: whether it began in its initiation set; outside it is a single step.
        chosen: The augmented action that the run began with, if the present one did not count (`OptionsVecEnv`).
    """

    index: int  # type: ignore[assignment]  # hides tuple.index, which nobody calls
    duration: int
    discount: float
    gamma: float
    termination: Termination
    observations: Observations | None = None
    actions: IntArray | None = None
    rewards: FloatArray | None = None
    available: BoolArray | None = None
    inside: bool | None = None
    chosen: int | None = None

    def as_info(self) -> RunInfo:
        """Return the value of ``info["option"]``: a dict of the fields that are not None."""
        return RunInfo((name, value) for name, value in zip(self._fields, self, strict=True) if value is not None)

    @classmethod
    def from_info(cls, info: Mapping[str, Any]) -> OptionRun:
        """Return the record in an info of `OptionsWrapper`, or of an environment whose actions have own durations.

        Such an environment leaves ``info["option"] = {"duration": k, "discount": gamma**k}`` at least.

        Raises:
            ValueError: There is no such record, or it lacks duration or discount, or they are out of range. The record
                of `OptionsWrapper` is complete, and not checked again.
        """
        try:
            option = info["option"]
            get = option.get
            # Not by `_make`, which counts the fields: this runs once or twice in every step.
            return tuple.__new__(
                cls,
                (
                    option["index"],
                    option["duration"],
                    option["discount"],
                    option["gamma"],
                    option["termination"],
                    get("observations"),
                    get("actions"),
                    get("rewards"),
                    get("available"),
                    get("inside"),
                    get("chosen"),
                ),
            )
        except (AttributeError, KeyError, TypeError):
            return _completed(info.get("option"))


class RunInfo(dict[str, Any]):
    """Value of ``info["option"]``. Vectorised environments do not copy it: only `OptionsWrapper` changes it."""

    def __deepcopy__(self, memo: Any) -> RunInfo:
        return self


def _completed(option: Any) -> OptionRun:
    """Complete the record of a user's own environment, of which only duration and discount are required."""
    if option is None:
        raise ValueError(
            'There is no info["option"]: wrap the environment in OptionsWrapper, or, if its actions have durations of '
            'their own, let its step leave info["option"] = {"index": -1, "duration": k, "discount": gamma**k}.'
        )
    is_dict = isinstance(option, Mapping)
    k, discount = (_number(option.get(name)) if is_dict else None for name in ("duration", "discount"))
    if not (isinstance(k, Real) and isinstance(discount, Real) and float(k) > 0 and 0 <= float(discount) <= 1):
        raise ValueError(
            'info["option"] must be a dict with a positive "duration" in primitive steps and a "discount" between 0 '
            f"and 1, got {option!r:.200}: let the environment's step leave "
            '{"index": -1, "duration": k, "discount": gamma**k}, or give what it leaves there another name.'
        )
    known = {name: option[name] for name in OptionRun._fields if name in option}
    known |= {"duration": k, "discount": discount}
    usual = {"index": -1, "gamma": float(discount) ** (1.0 / float(k)), "termination": "primitive"}
    return OptionRun(**{**usual, **known})


def _number(value: Any) -> Any:
    """Return the number in an array of length 1."""
    return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
