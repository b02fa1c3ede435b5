"""Places that were candidates often enough."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Annotated, Any, TypeAlias

import numpy as np

from sb3_options.checked import Field
from sb3_options.density.arrays import row_keys
from sb3_options.density.regions import Region
from sb3_options.discovery.methods.method import Experience, Method
from sb3_options.experience.observations import FloatArray, IntArray

Count: TypeAlias = Annotated[int, Field(ge=1)]
Share: TypeAlias = Annotated[float, Field(gt=0, lt=1)]
Positive: TypeAlias = Annotated[float, Field(gt=0, allow_inf_nan=False)]
"""Arguments of methods, which `pydantic.validate_call` checks."""

Accept = Callable[[FloatArray, FloatArray], FloatArray]
"""How often places were seen and how often they were candidates, (n,) each → by how much each is accepted, (n,).

Positive where it is.
"""

MAX_PLACES, MAX_NUMBERS = 20_000, 8_000_000
"""As many places are remembered, and as many features of them, 64 MB; beyond that, those not seen for longest are
forgotten."""

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
        self._row: OrderedDict[bytes, int] = OrderedDict()  # of each place, those not seen for longest first
        self._points = np.zeros((0, 0))
        self._counts = np.zeros((0, 3))  # seen, candidate, and whether it may be a subgoal

    def __len__(self) -> int:
        """How many places are remembered."""
        return len(self._row)

    def add(self, experience: Experience, seen: IntArray, hits: IntArray) -> None:
        """Count."""
        places = experience.places
        those = np.flatnonzero(seen)
        if not len(those):
            return
        rows = self._rows_of(row_keys(places.bins[those]), places.points[those])
        self._counts[rows, 0] += seen[those]
        self._counts[rows, 1] += hits[those]
        self._counts[rows, 2] = places.allowed[those]
        self._forget()

    def _rows_of(self, keys: list[bytes], points: FloatArray) -> IntArray:
        """Rows of these places, which are those that were seen last from now on; new ones get a row."""
        n = len(self._row)
        rows = np.array([self._row.setdefault(key, len(self._row)) for key in keys], dtype=np.int64)
        for key in keys:
            self._row.move_to_end(key)
        if len(self._row) > len(self._points):
            more = max(min(2 * len(self._points), most_places(points.shape[1])), len(self._row))
            self._points = _longer(self._points.reshape(-1, points.shape[1]), more)
            self._counts = _longer(self._counts, more)
        new = rows >= n
        self._points[rows[new]] = points[new]
        return rows

    def _forget(self) -> None:
        """Forget those not seen for longest, if they are too many."""
        most = most_places(self._points.shape[1])
        if len(self._row) <= most:
            return
        kept = list(self._row.items())[-most:]
        rows = np.array([row for _, row in kept])
        self._row = OrderedDict((key, i) for i, (key, _) in enumerate(kept))
        self._points, self._counts = self._points[rows], self._counts[rows]

    def proposals(self, experience: Experience) -> list[Region]:
        """The places that are accepted and may be subgoals, best first."""
        rows = np.fromiter(self._row.values(), np.int64, len(self._row))
        rows = rows[self._counts[rows, 2] > 0]
        if not len(rows):
            return []
        accepted = self.accept(self._counts[rows, 0], self._counts[rows, 1])
        order = np.argsort(-accepted, kind="stable")
        return [experience.region(self._points[rows[i]]) for i in order if accepted[i] > 0]

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint: the places, those not seen for longest first."""
        rows = np.fromiter(self._row.values(), np.int64, len(self._row))
        return {
            "bins": np.array([np.frombuffer(key) for key in self._row]),
            "points": self._points[rows],
            "counts": self._counts[rows],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._row = OrderedDict((of.tobytes(), row) for row, of in enumerate(state["bins"]))
        self._points, self._counts = np.array(state["points"]), np.array(state["counts"])


def most_places(n_features: int) -> int:
    """How many places are remembered, at least 1."""
    return min(MAX_PLACES, max(MAX_NUMBERS // max(n_features, 1), 1))


def _longer(rows: FloatArray, n: int) -> FloatArray:
    """The same rows, and room for more of them."""
    return np.concatenate([rows, np.zeros((n - len(rows), rows.shape[1]))])


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
