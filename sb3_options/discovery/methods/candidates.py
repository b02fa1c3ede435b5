"""Places that were candidates often enough."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_options.density.arrays import row_keys
from sb3_options.density.regions import Region
from sb3_options.discovery.methods.method import Experience, Method
from sb3_options.experience.observations import FloatArray, IntArray

Accept = Callable[[FloatArray, FloatArray], FloatArray]
"""How often places were seen and how often they were candidates, (n,) each → by how much each is accepted, (n,).

Positive where it is.
"""

MAX_PLACES, MAX_NUMBERS = 20_000, 8_000_000
"""As many places are remembered, and as many features of them, 64 MB; of places that come later nothing is known."""

PLACE_SECONDS = 2e-7
"""Nominal time of an update, for each place that is remembered."""


def often_enough(min_seen: int, min_share: float) -> Accept:
    """Accept places seen often enough that were candidates in this share of the times (Şimşek, Wolfe & Barto 2005)."""

    def accept(seen: FloatArray, hits: FloatArray) -> FloatArray:
        margin = hits / np.maximum(seen, 1.0) - min_share
        accepted: FloatArray = np.where(seen >= min_seen, margin, -1.0)
        return accepted

    return accept


def more_likely(p_target: float, p_other: float, odds: float) -> Accept:
    """Accept where the likelihood ratio of two binomial distributions exceeds ``odds`` (Şimşek & Barto 2004)."""

    def accept(seen: FloatArray, hits: FloatArray) -> FloatArray:
        evidence = hits * np.log(p_target / p_other) + (seen - hits) * np.log((1 - p_target) / (1 - p_other))
        margin: FloatArray = evidence - np.log(odds)
        return margin

    return accept


class Candidates:
    """Counts for every place how often it was seen and how often it was a candidate."""

    def __init__(self, accept: Accept) -> None:
        self.accept = accept
        self._row: dict[bytes, int] = {}  # of each place
        self._points: list[FloatArray] = []
        self._counts = np.zeros((0, 3))  # seen, candidate, and whether it may be a subgoal

    def __len__(self) -> int:
        """How many places are remembered."""
        return len(self._row)

    def add(self, experience: Experience, seen: IntArray, hits: IntArray) -> None:
        """Count how often each place of a trajectory was seen, and was a candidate."""
        places = experience.places
        those = np.flatnonzero(seen)
        room = max(min(MAX_PLACES, MAX_NUMBERS // places.points.shape[1]), 1)
        keys = row_keys(places.bins[those])
        new = [i for i, key in enumerate(keys) if key not in self._row][: room - len(self._row)]
        self._row |= {keys[i]: len(self._row) + n for n, i in enumerate(new)}
        self._points.extend(places.points[those[new]])
        self._counts = np.concatenate([self._counts, np.zeros((len(new), 3))])
        known = np.array([key in self._row for key in keys], dtype=bool)
        rows = [self._row[key] for key in keys if key in self._row]
        counted = those[known]
        self._counts[rows, 0] += seen[counted]
        self._counts[rows, 1] += hits[counted]
        self._counts[rows, 2] = places.allowed[counted]

    def proposals(self, experience: Experience) -> list[Region]:
        """The places that are accepted and may be subgoals, best first."""
        rows = np.flatnonzero(self._counts[:, 2])
        if not len(rows):
            return []
        accepted = self.accept(self._counts[rows, 0], self._counts[rows, 1])
        order = np.argsort(-accepted, kind="stable")
        return [experience.region(self._points[rows[i]]) for i in order if accepted[i] > 0]

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        bins = np.array([np.frombuffer(key) for key in self._row])
        return {"bins": bins, "points": np.array(self._points), "counts": self._counts.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._row = {of.tobytes(): row for row, of in enumerate(state["bins"])}
        self._points, self._counts = list(state["points"]), np.array(state["counts"])


class CandidateMethod(Method):
    """A method of discovery whose subgoals are the places that were candidates often enough."""

    STATE = ("_candidates",)

    def __init__(self, accept: Accept) -> None:
        self._candidates = Candidates(accept)

    def _counted(self, experience: Experience, seen: IntArray, hits: IntArray) -> list[Region]:
        """Count what `Candidates.add` counts, and propose."""
        self._candidates.add(experience, seen, hits)
        return self._candidates.proposals(experience)

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        del experience
        return PLACE_SECONDS * len(self._candidates)
