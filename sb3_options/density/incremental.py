"""Peaks of diverse density while bags come and go one by one, each time from the peaks of the last search."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags, distinct
from sb3_options.density.concepts import Point
from sb3_options.density.diverse_density import Peak, best_apart
from sb3_options.density.evidence import Evidence
from sb3_options.density.search import ConceptSearch, Solution

FIRST_BAGS = 3
"""The first search starts from instances of this many bags, later ones from those of the newest bag alone."""

FIRST_STEPS = 30
"""Most evaluations of the first search; later ones go on from where it ended."""

JURY = 12
"""If not all instances of the newest bag can be tried, this many positive and negative bags say which."""


class IncrementalSearch:
    """Search for points of a known scale that remembers its bags and its peaks.

    A bag that was not there at the last search is packed and added, one that is gone is removed, and the last peaks
    climb on, beside instances of the newest positive bag: it holds an instance of the concept too. All of them while
    there is little evidence, so that whatever ties is found; the best few when there is much.

    Args:
        scale: Factor for every feature, shape (d,).
        negative_strength: η in (0, 1].
    """

    def __init__(self, scale: FloatArray, negative_strength: float) -> None:
        self.scale = scale
        self._concepts = ConceptSearch(concept=Point("fixed"), scale=scale, negative_strength=negative_strength)
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
        starts = distinct(np.concatenate(positive[-FIRST_BAGS if first else -1 :]))
        most = self._concepts.update_starts(self._evidence)
        if len(starts) > most:
            starts = self._best(starts, most, _evenly(positive, JURY), _evenly(negative, JURY))
        self._peaks = self._concepts.update(self._evidence, self._peaks, starts, steps=FIRST_STEPS if first else None)
        return [
            Peak(solution.region().points[0], self.scale, solution.log_density, solution.converged)
            for solution in self._peaks
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

    def _best(
        self, instances: FloatArray, n: int, positive: Sequence[FloatArray], negative: Sequence[FloatArray]
    ) -> FloatArray:
        """Up to ``n`` instances that lie apart, best first, by the nearest instance of each of these bags."""
        scaled = instances * self.scale
        density = np.zeros(len(instances))
        for bags, is_positive in ((positive, True), (negative, False)):
            for bag in bags:
                distance = cKDTree(bag * self.scale).query(scaled)[0]
                p = np.exp(-(distance**2)).clip(max=1 - np.finfo(np.float64).eps)
                density += -(distance**2) if is_positive else np.log1p(-self._concepts.negative_strength * p)
        kept: FloatArray = instances[best_apart(scaled, density, self._concepts.merge_radius, n)]
        return kept


def _evenly(bags: Sequence[FloatArray], n: int) -> list[FloatArray]:
    """Up to ``n`` of the bags, evenly spaced."""
    return [bags[i] for i in np.unique(np.linspace(0, len(bags) - 1, min(n, len(bags))).round().astype(np.int64))]
