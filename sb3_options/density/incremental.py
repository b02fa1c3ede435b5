"""Peaks of diverse density while bags come and go one by one, each time from the peaks of the last search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity, Peak
from sb3_options.density.evidence import Evidence
from sb3_options.density.search import Solution

FIRST_BAGS = 3
"""The first search starts from instances of this many bags, later ones from those of the newest bag alone."""

FIRST_STEPS = 30
"""Most evaluations of the first search; later ones go on from where it ended."""


class IncrementalSearch:
    """Search for points of a known scale that remembers its bags and its peaks.

    A bag that was not there at the last search is packed and added, one that is gone is removed, and the last peaks
    climb on, beside instances of the newest positive bag: it holds an instance of the concept too. All of them while
    there is little evidence, so that whatever ties is found; the best few when there is much.

    Args:
        engine: What is searched for.
    """

    def __init__(self, engine: DiverseDensity) -> None:
        self._engine, self._concepts = engine, engine.concepts
        self._evidence: Evidence | None = None
        self._bags: list[FloatArray] = []  # as numbered in the evidence
        self._peaks: list[Solution] = []

    def search(self, positive: Sequence[FloatArray], negative: Sequence[FloatArray] = ()) -> list[Peak]:
        """Search for peaks, best first.

        Args:
            positive: Bags (n_i, d), at least one, the newest last. A bag is known again by being the same array, so
                an array stands for one bag only.
            negative: Likewise, perhaps none.

        Returns:
            A few peaks, no two within half a width; densities are in single precision.
        """
        first = not self._follow(positive, negative)
        if first:
            self._evidence = self._concepts.evidence(Bags.pack(positive, negative))
            self._bags, self._peaks = [*positive, *negative], []
        assert self._evidence is not None  # made or followed
        starts = np.concatenate(positive[-FIRST_BAGS if first else -1 :])
        self._peaks = self._concepts.update(self._evidence, self._peaks, starts, steps=FIRST_STEPS if first else None)
        return self._engine.peaks(self._peaks)

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint. The arrays of bags are those that `search` was given."""
        if self._evidence is None:
            return {"evidence": None}
        peaks = [(peak.theta, peak.log_density, peak.converged) for peak in self._peaks]
        return {"evidence": self._evidence.get_state(), "bags": list(self._bags), "peaks": peaks}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave; `search` must be given the same arrays again."""
        if state["evidence"] is None:
            return
        self._bags = state["bags"]
        self._evidence = evidence = self._concepts.evidence(Bags.pack(self._bags))
        evidence.set_state(state["evidence"])
        concept = self._concepts.concept
        self._peaks = [
            Solution(concept, theta, evidence.frame, density, rested) for theta, density, rested in state["peaks"]
        ]

    def _follow(self, positive: Sequence[FloatArray], negative: Sequence[FloatArray]) -> bool:
        """Bring the evidence up to date; False if it is better made anew, with more than half of the bags new."""
        known = {id(bag) for bag in self._bags}
        new = [(bag, bags is positive) for bags in (positive, negative) for bag in bags if id(bag) not in known]
        if self._evidence is None or 2 * len(new) > len(positive) + len(negative):
            return False
        current = {id(bag) for bags in (positive, negative) for bag in bags}
        for number in reversed(range(len(self._bags))):
            if id(self._bags[number]) not in current:
                self._evidence.remove(number)
                del self._bags[number]
        for bag, is_positive in new:
            self._evidence.add(bag, positive=is_positive)
            self._bags.append(bag)
        return True
