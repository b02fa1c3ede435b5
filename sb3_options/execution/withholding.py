"""The environment's side of an option's trial: which options this episode does without, and what it returned."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypedDict

import numpy as np


class TrialReport(TypedDict):
    """What the info that ends an episode holds as ``info["option_trial"]``.

    Attributes:
        withheld: Of each slot that was filled when the episode began, whether it was withheld.
        used: The slots that ran.
        outcome: Σ γᵗ rₜ of the episode.
    """

    withheld: dict[int, bool]
    used: set[int]
    outcome: float


class Withholding:
    """Draws for every episode which options it does without.

    Args:
        seed: Of a generator of its own, so that nothing else draws differently because of a trial.
    """

    def __init__(self, seed: Sequence[int]) -> None:
        self.random = np.random.default_rng(seed)
        self.shares: dict[int, float] = {}
        self._drawn: dict[int, bool] = {}
        self.begin(())

    def begin(self, filled: Iterable[int]) -> None:
        """An episode begins with these slots filled."""
        # One draw for every slot that is tried, so that the slots are independent of each other.
        self._drawn = {slot: bool(self.random.random() < self.shares[slot]) for slot in filled if slot in self.shares}
        self._used: set[int] = set()
        self._outcome, self._discount = 0.0, 1.0

    def holds(self, slot: int) -> bool:
        """Whether this episode does without the option in ``slot``."""
        return self._drawn.get(slot, False)

    def withheld(self) -> list[int]:
        """The slots this episode does without."""
        return [slot for slot, drawn in self._drawn.items() if drawn]

    def note_use(self, slot: int) -> None:
        """The option in ``slot`` ran."""
        self._used.add(slot)

    def note_reward(self, reward: float, gamma: float) -> None:
        """One primitive step was rewarded."""
        self._outcome += self._discount * reward
        self._discount *= gamma

    def report(self) -> TrialReport | None:
        """What the episode that ends tells; None if no option was tried in it."""
        return {"withheld": self._drawn, "used": self._used, "outcome": self._outcome} if self._drawn else None
