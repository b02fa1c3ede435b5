"""Places that were candidates often enough."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_options.checked import is_number, whole
from sb3_options.density.regions import Region
from sb3_options.discovery.methods.method import Experience
from sb3_options.experience.observations import FloatArray, IntArray

Accept = Callable[[FloatArray, FloatArray], FloatArray]
"""How often places were seen and how often they were candidates, (n,) each → by how much each is accepted, (n,).

Positive where it is.
"""

MAX_PLACES = 20_000
"""As many are remembered; beyond that, those not seen for longest are forgotten."""


def check_counts(**counts: object) -> None:
    """Refuse what is no whole number of at least 1, by its name.

    Raises:
        ValueError: There is such a one.
    """
    for name, count in counts.items():
        if not whole(count, 1):
            raise ValueError(f"{name} must be a whole number of at least 1, got {count!r}.")


def check_shares(**shares: object) -> None:
    """Refuse what is no number in (0, 1), by its name.

    Raises:
        ValueError: There is such a one.
    """
    for name, share in shares.items():
        if not (is_number(share) and 0 < share < 1):  # type: ignore[operator]  # it is a number
            raise ValueError(f"{name} must be in (0, 1), got {share!r}.")


def often_enough(min_seen: int, min_share: float) -> Accept:
    """Accept what was seen so often and was a candidate in this share of the times (Şimşek, Wolfe & Barto 2005).

    Args:
        min_seen: t_o.
        min_share: t_p, in (0, 1).

    Raises:
        ValueError: An argument is out of its range.
    """
    check_counts(min_seen=min_seen)
    check_shares(min_share=min_share)

    def accept(seen: FloatArray, hits: FloatArray) -> FloatArray:
        margin = hits / np.maximum(seen, 1.0) - min_share
        accepted: FloatArray = np.where(seen >= min_seen, margin, -1.0)
        return accepted

    return accept


def more_likely(p_target: float, p_other: float, odds: float) -> Accept:
    """Accept where the likelihood ratio of two binomial distributions exceeds ``odds`` (Şimşek & Barto 2004).

    Args:
        p_target: p: how often a subgoal is a candidate when it is seen.
        p_other: q: how often any other state is.
        odds: λ_fa/λ_miss · p(N)/p(T): cost of false alarms to that of misses, times the prior odds of other states.

    Raises:
        ValueError: An argument is out of its range, or subgoals are to be candidates no oftener than others.
    """
    check_shares(p_target=p_target, p_other=p_other)
    if not (p_target > p_other and odds > 0):
        raise ValueError(f"p_target must be above p_other, and odds above 0, got {p_target}, {p_other} and {odds}.")

    def accept(seen: FloatArray, hits: FloatArray) -> FloatArray:
        evidence = hits * np.log(p_target / p_other) + (seen - hits) * np.log((1 - p_target) / (1 - p_other))
        margin: FloatArray = evidence - np.log(odds)
        return margin

    return accept


@dataclass
class _Place:
    point: FloatArray
    seen: float = 0.0
    hits: float = 0.0
    allowed: bool = True


class Candidates:
    """Counts for every place how often it was seen and how often it was a candidate.

    Args:
        accept: Which places become subgoals.
    """

    def __init__(self, accept: Accept) -> None:
        self.accept = accept
        self._places: OrderedDict[bytes, _Place] = OrderedDict()

    def add(self, experience: Experience, seen: IntArray, hits: IntArray) -> None:
        """Count.

        Args:
            experience: The trajectory.
            seen: How often each of its places was seen, (k,).
            hits: How often it was a candidate, (k,).
        """
        places = experience.places
        for row in np.flatnonzero(seen):
            key = places.bins[row].tobytes()
            place = self._places.setdefault(key, _Place(places.points[row]))
            place.seen += float(seen[row])
            place.hits += float(hits[row])
            place.allowed = bool(places.allowed[row])
            self._places.move_to_end(key)
        while len(self._places) > MAX_PLACES:
            self._places.popitem(last=False)

    def proposals(self, experience: Experience) -> list[Region]:
        """The places that are accepted and may be subgoals, best first."""
        places = [place for place in self._places.values() if place.allowed]
        if not places:
            return []
        seen, hits = np.array([[place.seen, place.hits] for place in places]).T
        accepted = self.accept(seen, hits)
        order = np.argsort(-accepted, kind="stable")
        return [experience.region(places[i].point) for i in order if accepted[i] > 0]

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint: the places, those not seen for longest first."""
        places = self._places.values()
        return {
            "bins": np.array([np.frombuffer(key) for key in self._places]),
            "points": np.array([place.point for place in places]),
            "counts": np.array([(place.seen, place.hits, place.allowed) for place in places], dtype=np.float64),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._places = OrderedDict(
            (of.tobytes(), _Place(point, float(seen), float(hits), bool(allowed)))
            for of, point, (seen, hits, allowed) in zip(state["bins"], state["points"], state["counts"], strict=True)
        )


class CandidateMethod:
    """A method of discovery whose subgoals are the places that were candidates often enough.

    Args:
        accept: Which places become subgoals.
    """

    def __init__(self, accept: Accept) -> None:
        self._candidates = Candidates(accept)

    def _counted(self, experience: Experience, seen: IntArray, hits: IntArray) -> list[Region]:
        """Count what `Candidates.add` counts, and propose."""
        self._candidates.add(experience, seen, hits)
        return self._candidates.proposals(experience)

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return self._candidates.get_state()

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._candidates.set_state(state)
