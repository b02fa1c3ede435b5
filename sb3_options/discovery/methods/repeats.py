"""A control: options that repeat one action."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_options.discovery.methods.candidates import check_counts
from sb3_options.discovery.methods.method import Experience, Proposal, Repeat

EXPONENT = 2.0
"""μ of the zeta distribution that durations are drawn from (Dabney, Ostrovski & Barreto 2021, §4)."""

LEAST = 2
"""Primitive steps: an option of one step is the action itself."""


class RandomRepeats:
    """A control: an option that repeats a primitive action for some steps, as in ε-z-greedy exploration.

    Durations are drawn from a zeta distribution (Dabney, Ostrovski & Barreto 2021, §4), of those of two steps and more.
    The first option repeats a random action, the next one the action after it, so that as many are repeated as there
    are options.

    Args:
        seed: Of the generator that draws.

    Raises:
        ValueError: ``seed`` is no whole number of at least 0.
    """

    def __init__(self, *, seed: int = 0) -> None:
        check_counts(0, seed=seed)
        self._random = np.random.default_rng(seed)
        self._number = int(self._random.integers(np.iinfo(np.int32).max))

    def update(self, experience: Experience) -> list[Proposal]:
        """Propose another repeat; as `DiscoveryMethod.update`."""
        self._number += 1
        duration = 0
        while duration < LEAST:
            duration = int(self._random.zipf(EXPONENT))
        return [Repeat(self._number, duration, experience.scale)]

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"number": self._number, "random": self._random.bit_generator.state}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._number = state["number"]
        self._random.bit_generator.state = state["random"]
