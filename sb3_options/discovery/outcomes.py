"""What the trajectories that discovery has seen were like, for a user who asks why it found nothing."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from typing import Any

from sb3_options.experience.trajectories import Trajectory

logger = logging.getLogger("sb3_options")

SILENT_TRAJECTORIES = 20
"""There is a warning when none of this many first trajectories was successful."""


@dataclass
class Outcomes:
    """Counts trajectories, and warns once if none succeeds.

    Args:
        unit: What a trajectory is, for texts: an episode, or a segment of a continuing task.
        judged_by_user: Whether the rule of success is the user's own.
        needed: Whether nothing can be discovered before a success.

    Attributes:
        n: Trajectories seen.
        successes: Successful ones.
    """

    unit: str = "episode"
    judged_by_user: bool = False
    needed: bool = True
    n: int = field(default=0, init=False)
    successes: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        """Nothing was seen yet."""
        self._terminated = self._reported = 0
        self._returns: tuple[float, float] = (float("inf"), float("-inf"))

    def add(self, trajectory: Trajectory, *, success: bool) -> None:
        """Count one."""
        self.n += 1
        self.successes += success
        self._terminated += trajectory.terminated
        self._reported += trajectory.is_success is not None
        total = float(trajectory.rewards.sum())
        self._returns = min(self._returns[0], total), max(self._returns[1], total)
        if self.needed and self.n == SILENT_TRAJECTORIES and not self.successes:
            logger.warning("Nothing can be discovered so far: %s", self.why_no_success())

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"counts": (self.n, self.successes, self._terminated, self._reported), "returns": self._returns}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self.n, self.successes, self._terminated, self._reported = state["counts"]
        self._returns = state["returns"]

    def why_none_ended(self) -> str:
        """That nothing was seen to its end, and what to do."""
        if self.unit == "segment":
            return "no segment has ended. Choose a smaller max_segment of DiscoverySettings, or train for longer."
        return (
            "no episode has ended. Train for longer, or give the environment a time limit, gym.make(..., "
            "max_episode_steps=...). A task that goes on for ever is cut at peaks of reward: "
            'DiscoverySettings(segmentation="peaks").'
        )

    def why_no_success(self) -> str:
        """What was seen where nothing succeeded, and what to do."""
        if self.unit == "segment":
            return (
                f"none of the {self.n} segments seen ended with a peak of reward. Choose peak_reward and max_segment "
                "of DiscoverySettings for this task."
            )
        low, high = self._returns
        if not (math.isfinite(low) and math.isfinite(high)):
            return (
                f"rewards in the {self.n} episodes seen are NaN or infinite. OptionsWrapper(..., check_finite=True), "
                "which train.py passes, shows where."
            )
        seen = (
            f"none of the {self.n} episodes seen counts as a success. {self._terminated} ended in a terminal state, "
            f"{self.n - self._terminated} were cut off, with returns from {low:g} to {high:g}; "
        )
        if self.judged_by_user:
            return seen + "the rule given as success=... was true of none of them."
        if self._reported == self.n:
            return seen + 'info["is_success"] was false in all of them. If it means something else, pass success=...'
        seen += 'the environment reports no info["is_success"], and no terminal state brought a positive reward above '
        seen += "all earlier ones. "
        if not self._terminated and low == high:
            seen += "All went alike, so perhaps the goal was not found so far: explore more. Else say"
        elif low == high == 0.0:
            seen += "If the goal is a reward, it was not found so far: explore more. Else say"
        else:
            seen += "Say"
        return (
            f"{seen} what success is: SubgoalDiscoveryCallback(success=lambda trajectory: trajectory.terminated) where "
            "every terminal state is a good one, or sb3_options.experience.success.success_by_return(threshold). "
            "On the command line and in YAML that is success: terminated, or success: return:NUMBER."
        )
