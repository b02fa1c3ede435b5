"""The diary of discovery: counts of trajectories, cost of searches, and why nothing was found."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from sb3_options.discovery.budget import SHORTEST, STEP_SECONDS, TABLE_SHORTEST, TABLE_STEP_SECONDS, seconds_of_look
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import Trajectory
from sb3_options.state import TRANSIENT

if TYPE_CHECKING:
    from sb3_options.discovery.methods.method import Method

EXPLORE = "Train for longer, or add an exploration bonus: train.py --bonus rnd, in a script IntrinsicRewardCallback."
"""The remedy where success is known and was not reached."""

logger = logging.getLogger("sb3_options")

SILENT_TRAJECTORIES = 20
"""Trajectories without a success after which a warning is logged."""

TREE_FEATURES = 16
"""Largest number of features of a k-d tree."""

SAMPLED = 4
"""States of each trajectory, about, by which the features that vary most are chosen."""


@dataclass
class Diary:
    """Counts of trajectories and of nominal seconds, and the reasons why discovery found nothing.

    Args:
        unit: What a trajectory is: an ``episode``, or a ``segment`` of a continuing task.
        own_rule: Whether the rule of success is the user's.
        max_share: Largest share of training time for discovery; None for any.
        least: Trajectories before the first search for places that recur.
        radius: Two states within this distance are one place, in scaled units.

    Attributes:
        needs_success: Whether nothing can be discovered before a success.
        n: Trajectories seen.
        successes: Successful ones.
        steps: Primitive steps of all trajectories.
        step_seconds: Nominal seconds of training for a primitive step.
        spent: Nominal seconds of discovery.
        skipped: Searches that were not made, because the budget was spent.
        seconds: Measured seconds of discovery. No decision depends on them.
        n_withdrawn: Subgoals for which no option could be learned.
        recurs: Whether two trajectories came near the same place.
    """

    unit: str = "episode"
    own_rule: bool = field(default=False, metadata=TRANSIENT)
    max_share: float | None = field(default=None, metadata=TRANSIENT)
    least: int = field(default=2, metadata=TRANSIENT)
    radius: float = field(default=1.0, metadata=TRANSIENT)
    needs_success: bool = field(default=True, metadata=TRANSIENT)
    step_seconds: float = field(default=STEP_SECONDS, metadata=TRANSIENT)
    n: int = 0
    successes: int = 0
    terminated: int = 0
    reported: int = 0
    lowest: float = float("inf")
    highest: float = float("-inf")
    steps: int = 0
    spent: float = 0.0
    skipped: int = 0
    seconds: float = 0.0
    n_withdrawn: int = 0
    recurs: bool = False
    n_unusable: int = 0
    last_error: str = ""
    without_option: set[str] = field(default_factory=set)
    _compared: int = 0  # trajectories when places were last compared, and what they were
    _what: str = ""
    _warned_of_recurrence: bool = False
    _first_step: int | None = None
    _warned_of_no_end: bool = False

    def add(self, trajectory: Trajectory, *, success: bool) -> None:
        """Count a trajectory, and warn once if none of the first ones succeeded."""
        self.n += 1
        self.successes += success
        self.terminated += trajectory.terminated
        self.reported += trajectory.is_success is not None
        self.steps += len(trajectory)
        total = float(trajectory.rewards.sum())
        self.lowest = min(self.lowest, total)
        self.highest = max(self.highest, total)
        if self.needs_success and self.n == SILENT_TRAJECTORIES and not self.successes:
            logger.warning("Discovery waits for a success: there was none in the first %d %ss.", self.n, self.unit)

    def affords(self) -> bool:
        """Whether the budget allows another search. A search that cost too much is paid off before the next one."""
        shortest = TABLE_SHORTEST if self.step_seconds == TABLE_STEP_SECONDS else SHORTEST
        if self.max_share is None or self.spent <= self.max_share * self.step_seconds * max(shortest, self.steps):
            return True
        self.skipped += 1
        return False

    def unusable(self, episode: int, error: Exception) -> None:
        """Count an episode that cannot be used, and warn of the first, the second, the fourth and so on."""
        self.n_unusable += 1
        self.last_error = f"{type(error).__name__}: {error}"
        if self.n_unusable & (self.n_unusable - 1) == 0:
            times = "" if self.n_unusable == 1 else f" (so far {self.n_unusable} times)"
            logger.warning("No discovery after episode %d%s: %s", episode, times, error)

    def no_option(self, where: str) -> None:
        """Warn once for each subgoal that no option could be learned."""
        if where not in self.without_option:
            self.without_option.add(where)
            logger.warning("No option for %s: no saved trajectory leads to it (surely enough, min_reach).", where)

    def no_end(self, steps: int, n_envs: int, longest: int) -> None:
        """Warn once if no episode has ended after ``longest`` steps of each environment."""
        self._first_step = steps if self._first_step is None else self._first_step
        if self._warned_of_no_end or steps - self._first_step < longest * n_envs:
            return
        self._warned_of_no_end = True
        logger.warning(
            "Nothing can be discovered so far: no episode has ended in %s primitive steps of each environment. End "
            "them with gymnasium.wrappers.TimeLimit, or let peaks of reward separate trajectories: "
            'DiscoverySettings(segmentation="peaks").',
            f"{longest:,}",
        )

    @property
    def nothing_recurs(self) -> bool:
        """Whether places were compared, and no two trajectories came near the same one."""
        return self._compared > 0 and not self.recurs

    def compare_places(self, n: int, states: Callable[[], Sequence[FloatArray]], what: str) -> None:
        """Find out whether any place recurs; what no two trajectories have in common is no concept.

        Places are compared after `least` trajectories, and each time their number has doubled, until a place recurs.

        Args:
            n: Trajectories that count.
            states: States of each that may be subgoals, (k_i, d) each, in scaled units.
            what: The trajectories, for the text.
        """
        least = max(self.least, 2)
        if self.recurs or n < max(least, 2 * self._compared):
            return
        kept = [each for each in states() if len(each)]
        if len(kept) < least:  # the others were forgotten, or the filters leave nothing of them
            return
        self._compared = n
        self._what = what
        self.recurs = any_recurs(kept, self.radius)
        if self.recurs:
            return  # which is soon seen
        self.spent += seconds_of_look(kept)
        if not self._warned_of_recurrence:
            self._warned_of_recurrence = True
            logger.warning("Nothing can be discovered so far: %s", self._why_nothing_recurs())

    def forget_places(self) -> None:
        """Compare places again: the feature map has changed."""
        self.recurs = False
        self._compared = 0

    def why_nothing(self, method: Method, n_found: int, n_episodes: int) -> str:
        """Why there is no option, in a sentence; the number of subgoals where there are some.

        Args:
            method: That searched.
            n_found: Subgoals that have an option.
            n_episodes: Trajectories that ended, with those that could not be used.
        """
        if n_found:
            return f"Subgoals discovered that have an option: {n_found}."
        unusable = (
            f"{self.n_unusable} of {n_episodes} episodes could not be used, the last one because of {self.last_error}."
        )
        if n_episodes and self.n_unusable == n_episodes:
            return f"No subgoal was discovered: {unusable}"
        why = f"No subgoal was discovered: {self._first_reason(method)}"
        if self.skipped and not self.nothing_recurs:
            why += (
                f" {self.skipped} searches were left out, because max_share={self.max_share:g} affords no more: a "
                "larger one, or features that are fewer, gives more of them."
            )
        return f"{why} And {unusable}" if self.n_unusable else why

    def _first_reason(self, method: Method) -> str:
        if self.n == 0:
            return self._why_none_ended()
        if method.needs_success and not method.n_successes(self):
            return self._why_no_success()
        if self.n_withdrawn:
            return "no saved trajectory leads to the one that was found (surely enough, min_reach)."
        if self.nothing_recurs:
            return self._why_nothing_recurs()
        return method.why_nothing(self)

    def _why_none_ended(self) -> str:
        if self.unit == "segment":
            return "no segment has ended. Choose a smaller max_segment of DiscoverySettings, or train for longer."
        return (
            "no episode has ended. Train for longer, or give the environment a time limit, gym.make(..., "
            "max_episode_steps=...). A task that goes on for ever is cut at peaks of reward: "
            'DiscoverySettings(segmentation="peaks").'
        )

    def _why_no_success(self) -> str:
        if self.unit == "segment":
            return (
                f"none of the {self.n} segments seen ended with a peak of reward. Choose max_segment of "
                "DiscoverySettings for this task."
            )
        if not (math.isfinite(self.lowest) and math.isfinite(self.highest)):
            return (
                f"rewards in the {self.n} episodes seen are NaN or infinite. OptionsWrapper(..., check_finite=True), "
                "which train.py passes, shows where."
            )
        seen = (
            f"no success in {self.n} episodes ({self.terminated} terminated, {self.n - self.terminated} truncated, "
            f"returns {self.lowest:g} to {self.highest:g})."
        )
        if self.own_rule:
            return f"{seen} Train for longer, or choose an easier success rule."
        if self.reported == self.n or self.lowest == self.highest:
            return f"{seen} {EXPLORE}"
        return (
            f"{seen} The environment reports none, and no episode ended with its highest reward. Name a rule of "
            "success: train.py --success terminated, or --success return:NUMBER; "
            'in a script success="terminated".'
        )

    def _why_nothing_recurs(self) -> str:
        return (
            f"nothing recurs. No two of {self._compared} {self._what} came within {self.radius:g} units of the same "
            "place, apart from where they began and ended. Where observations hardly ever repeat, pass a "
            "feature map that says where the agent is, OptionsWrapper(feature_map=...). Features of your own that "
            "are finer than a step want a smaller scale, DiscoverySettings(scale=...). If these have little in "
            "common, choose another rule, SubgoalDiscoveryCallback(success=...)."
        )


def any_recurs(states: Sequence[FloatArray], radius: float) -> bool:
    """Whether states of any two trajectories, (k_i, d) each, are within ``radius`` of each other.

    States that are farther apart in a few features are so in all. So trees of the features that vary most find the
    pairs that are worth comparing.
    """
    states = [each for each in states if len(each)]
    if len(states) < 2:
        return False
    if states[0].shape[1] <= TREE_FEATURES:
        trees = [cKDTree(each) for each in states]
        return any(b.count_neighbors(a, radius) > 0 for a, b in combinations(trees, 2))
    spread = np.concatenate([each[:: max(len(each) // SAMPLED, 1)] for each in states]).var(axis=0)
    few = np.argpartition(spread, -TREE_FEATURES)[-TREE_FEATURES:]
    trees = [cKDTree(each[:, few]) for each in states]
    for i, j in combinations(range(len(states)), 2):
        near = trees[i].query_ball_tree(trees[j], radius * (1 + 1e-9))
        for row, rows in enumerate(near):
            if rows and bool((np.linalg.norm(states[j][rows] - states[i][row], axis=1) <= radius).any()):
                return True
    return False
