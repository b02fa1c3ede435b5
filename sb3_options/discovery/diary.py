"""The diary of discovery: trajectory counts, search costs, and reasons why nothing was found."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sb3_options.discovery.budget import SHORTEST, STEP_SECONDS, TABLE_SHORTEST, TABLE_STEP_SECONDS
from sb3_options.experience.trajectories import Trajectory
from sb3_options.state import TRANSIENT

if TYPE_CHECKING:
    from sb3_options.discovery.methods.method import Method

logger = logging.getLogger("sb3_options")

SILENT_TRAJECTORIES = 20
"""A warning is logged after this many trajectories without a success."""


@dataclass
class Diary:
    """Counts trajectories and nominal seconds, and explains why discovery found nothing."""

    unit: str = "episode"  # or "segment", of a continuing task
    max_share: float | None = field(default=None, metadata=TRANSIENT)  # of training time; None for any
    needs_success: bool = field(default=True, metadata=TRANSIENT)
    step_seconds: float = field(default=STEP_SECONDS, metadata=TRANSIENT)  # nominal, of training
    n: int = 0  # trajectories seen
    successes: int = 0
    terminated: int = 0
    reported: bool = False  # whether the environment reports success itself, in ``info["is_success"]``
    lowest: float = float("inf")  # lowest return of a trajectory
    highest: float = float("-inf")
    steps: int = 0
    spent: float = 0.0  # nominal seconds of discovery
    skipped: int = 0  # searches that the budget did not afford
    seconds: float = 0.0  # measured processor seconds of discovery; no decision depends on them
    n_withdrawn: int = 0  # subgoals for which no option could be learned
    n_unusable: int = 0
    last_error: str = ""
    without_option: set[str] = field(default_factory=set)

    def add(self, trajectory: Trajectory, *, success: bool) -> None:
        """Count a trajectory. Warn once if none of the first `SILENT_TRAJECTORIES` succeeded."""
        self.n += 1
        self.successes += success
        self.terminated += trajectory.terminated
        self.reported |= trajectory.is_success is not None
        self.steps += len(trajectory)
        total = float(trajectory.rewards.sum())
        self.lowest = min(self.lowest, total)
        self.highest = max(self.highest, total)
        if self.needs_success and self.n == SILENT_TRAJECTORIES and not self.successes:
            logger.warning("Discovery waits for a success: there was none in the first %d %ss.", self.n, self.unit)

    def affords(self) -> bool:
        """Whether the budget allows another search. An expensive search delays the next one."""
        shortest = TABLE_SHORTEST if self.step_seconds == TABLE_STEP_SECONDS else SHORTEST
        if self.max_share is None or self.spent <= self.max_share * self.step_seconds * max(shortest, self.steps):
            return True
        self.skipped += 1
        return False

    def unusable(self, episode: int, error: Exception) -> None:
        """Count an unusable episode. Warn of the first, the second, the fourth and so on."""
        self.n_unusable += 1
        self.last_error = f"{type(error).__name__}: {error}"
        if self.n_unusable & (self.n_unusable - 1) == 0:
            times = "" if self.n_unusable == 1 else f" (so far {self.n_unusable} times)"
            logger.warning("No discovery after episode %d%s: %s", episode, times, error)

    def no_option(self, where: str) -> None:
        """Warn, once per subgoal, that no option could be learned."""
        if where not in self.without_option:
            self.without_option.add(where)
            logger.warning("No option for %s: no saved trajectory leads to it reliably enough.", where)

    def why_nothing(self, method: Method, n_found: int, n_episodes: int) -> str:
        """Say why there is no option; if there are some, say how many subgoals have one."""
        if n_found:
            return f"Subgoals discovered that have an option: {n_found}."
        unusable = (
            f"{self.n_unusable} of {n_episodes} episodes could not be used, the last one because of {self.last_error}."
        )
        if n_episodes and self.n_unusable == n_episodes:
            return f"No subgoal was discovered: {unusable}"
        why = f"No subgoal was discovered: {self._first_reason(method)}"
        if self.skipped and method.n_successes(self):
            why += f" {self.skipped} searches were left out to save time: raise max_share (--discovery.max-share)."
        return f"{why} And {unusable}" if self.n_unusable else why

    def _first_reason(self, method: Method) -> str:
        if self.n == 0:
            return (
                f"no {self.unit} has ended. Train for longer, or set a time limit: max_episode_steps=500 in gym.make "
                '(--env-kwargs max_episode_steps:500). An endless task needs segmentation="peaks" '
                "(--discovery.segmentation peaks)."
            )
        if method.needs_success and not method.n_successes(self):
            why = (
                f"no success in {self.n} {self.unit}s ({self.terminated} terminated, {self.n - self.terminated} "
                f"truncated, returns {self.lowest:g} to {self.highest:g}). "
            )
            if self.terminated and self.lowest < self.highest and not self.reported:
                return why + 'Say what counts as a success: success="terminated" or "return:NUMBER" (--success).'
            return why + 'Train for longer, or let PPO or A2C explore by IntrinsicRewardCallback("rnd") (--bonus rnd).'
        if self.n_withdrawn:
            return "no saved trajectory leads to the subgoal reliably enough. Train for longer."
        return method.why_nothing(self)
