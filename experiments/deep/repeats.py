"""The control: options that repeat one action for a random time, as in ε-z-greedy exploration."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_options.experience.observations import batch_size
from sb3_options.options.option import Option

EXPONENT = 2.0
"""μ of the zeta distribution that durations are drawn from (Dabney, Ostrovski & Barreto 2021, §4)."""

LONGEST = 100
"""Primitive steps: longer draws are cut to this, as discovered options are."""


class RandomRepeat(Option):
    """Repeats ``action``, for a time drawn from a zeta distribution when it starts; may start anywhere.

    Args:
        action: Primitive.
        generator: Draws the durations.
    """

    def __init__(self, action: int, generator: np.random.Generator) -> None:
        self._generator, self._action, self._left = generator, action, 0
        super().__init__(self._starts, self._repeats, self._ends, max_duration=LONGEST, name=f"repeat {action}")

    def _starts(self, observations: Any) -> Any:
        # The wrapper asks once before the first step, and after every step only when the repeats are not over.
        if self._left <= 0:
            self._left = int(min(self._generator.zipf(EXPONENT), LONGEST))
        return np.ones(batch_size(observations), dtype=bool)

    def _repeats(self, observations: Any) -> Any:
        self._left -= 1
        return np.full(batch_size(observations), self._action)

    def _ends(self, observations: Any) -> Any:
        return np.full(batch_size(observations), float(self._left <= 0))
