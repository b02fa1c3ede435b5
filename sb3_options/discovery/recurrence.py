"""Whether anything recurs: whether two successes ever came near the same place, apart from start and goal."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from sb3_options.experience.observations import FloatArray

logger = logging.getLogger("sb3_options")

TREE_FEATURES = 16
"""A k-d tree is made of as many features, at most."""

SAMPLED = 4
"""About as many states of each way say which features differ most."""

STATE_WAY_SECONDS, NUMBER_SECONDS = 1e-6, 1e-9
"""Nominal time of a look, for each pair of a state and a way, and for each feature of each state."""


class Recurrence:
    """Says once that nothing recurs, in words that name the remedy.

    What no two trajectories have in common is no concept, and a search for it finds accidents or nothing. It is looked
    at when ``least`` trajectories have succeeded, and each time they are twice as many, until something recurs.

    Args:
        least: Successful trajectories before the first look.
        radius: Two states within this distance are one place, in scaled units.

    Attributes:
        found: Whether something recurs.
    """

    def __init__(self, least: int, radius: float) -> None:
        self.least, self.radius = max(least, 2), radius
        self.found = False
        self._looked = 0
        self._told = False

    def forget(self) -> None:
        """Look anew: distances have become others."""
        self.found, self._looked = False, 0

    @property
    def nothing(self) -> bool:
        """Whether nothing has recurred so far."""
        return self._looked > 0 and not self.found

    def is_due(self, n: int) -> bool:
        """Whether to look, after ``n`` successful trajectories."""
        return not self.found and n >= max(self.least, 2 * self._looked)

    def look(self, ways: Sequence[FloatArray], n: int, what: str) -> float:
        """Look whether two ways come near the same place.

        Args:
            ways: States that may be subgoals, each (k_i, d), in scaled units.
            n: How many trajectories have succeeded.
            what: They are, for the text.

        Returns:
            What it took in nominal seconds; nothing where something recurs, which is soon seen.
        """
        ways = [way for way in ways if len(way)]
        if len(ways) < self.least:  # the others were forgotten, or the filters leave nothing of them
            return 0.0
        self._looked, self.found = n, recurs(ways, self.radius)
        if not (self._told or self.found):
            self._told = True
            logger.warning("Nothing can be discovered so far: %s", self.why(n, what, ways[0].shape[1]))
        return 0.0 if self.found else seconds_of_look(ways)

    def why(self, n: int, what: str, n_features: int | None = None) -> str:
        """What was seen, and what to do."""
        of = "" if n_features is None else f" of {n_features} features"
        return (
            f"nothing recurs. No two of {n} {what} came within {self.radius:g} units of the same place, apart from "
            f"where they began and ended, in a concept space{of}. Where observations hardly ever repeat, pass a "
            "feature map that says where the agent is, OptionsWrapper(feature_map=...). Features of your own that "
            "are finer than a step want a smaller scale, DiscoverySettings(scale=...). If these have little in "
            "common, choose another rule, SubgoalDiscoveryCallback(success=...)."
        )

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"found": self.found, "looked": self._looked, "told": self._told}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self.found, self._looked = state["found"], state["looked"]
        self._told = state.get("told", self._looked > 0)


def recurs(ways: Sequence[FloatArray], radius: float) -> bool:
    """Whether any two of these ways, each (k_i, d), have states within ``radius`` of each other.

    States that are farther apart than that in a few features are so in all. So trees of those that differ most tell
    which pairs need to be compared at all.
    """
    ways = [way for way in ways if len(way)]
    if len(ways) < 2:
        return False
    if ways[0].shape[1] <= TREE_FEATURES:
        trees = [cKDTree(way) for way in ways]
        return any(b.count_neighbors(a, radius) > 0 for a, b in combinations(trees, 2))
    spread = np.concatenate([way[:: max(len(way) // SAMPLED, 1)] for way in ways]).var(axis=0)
    few = np.argpartition(spread, -TREE_FEATURES)[-TREE_FEATURES:]
    trees = [cKDTree(way[:, few]) for way in ways]
    for i, j in combinations(range(len(ways)), 2):
        near = trees[i].query_ball_tree(trees[j], radius * (1 + 1e-9))
        for row, rows in enumerate(near):
            if rows and bool((np.linalg.norm(ways[j][rows] - ways[i][row], axis=1) <= radius).any()):
                return True
    return False


def seconds_of_look(ways: Sequence[FloatArray]) -> float:
    """Nominal time of a look that finds nothing."""
    n_states = sum(map(len, ways))
    d = ways[0].shape[1] if ways else 0
    return STATE_WAY_SECONDS * n_states * len(ways) + NUMBER_SECONDS * n_states * d
