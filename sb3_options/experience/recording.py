"""Tasks that go on: experience cut at peaks of reward, where no end of an episode cuts it.

McGovern & Barto (2001) make bags of episodes. A task that never ends, or whose episodes are only cut off by time, has
none, and its experience is segmented at peaks of reward instead (after Iba 1989): what lies between one peak and the
next is a trajectory that succeeded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral
from typing import Any

from sb3_options.experience.trajectories import TrajectoryRecorder


@dataclass(frozen=True)
class RewardPeaks:
    """Which steps are peaks of reward.

    Step t is a peak if r_t ≥ ``peak_reward`` and r_{t−1} < r_t ≥ r_{t+1}; before an episode and after it lies nothing
    that could be higher. So a reward that climbs over several steps peaks once, at its top, and one that stays high
    peaks once, where it began.

    Attributes:
        peak_reward: The least reward of a peak; None takes any that is positive.
        max_segment: A segment that has come to this many primitive steps without a peak is cut there, and failed. No
            more than this is ever held in memory. The next segment starts in mid-way, so that this should be more
            than an agent that explores at random takes from peak to peak.

    Raises:
        ValueError: A field is out of its range.
    """

    peak_reward: float | None = None
    max_segment: int = 10_000

    def __post_init__(self) -> None:
        """Refuse values out of range, by name."""
        if self.peak_reward is not None and not math.isfinite(self.peak_reward):
            raise ValueError(f"peak_reward must be finite, got {self.peak_reward}.")
        if not isinstance(self.max_segment, Integral) or self.max_segment < 1:
            raise ValueError(
                f"max_segment must be a whole number of primitive steps, at least 1, got {self.max_segment!r}."
            )

    def may_peak(self, reward: float, before: float) -> bool:
        """Whether a step with ``reward`` is a peak unless the next one is higher, given the reward ``before`` it."""
        enough = reward > 0.0 if self.peak_reward is None else reward >= self.peak_reward
        return enough and reward > before


class SegmentRecorder(TrajectoryRecorder):
    """Builds a `Trajectory` from each peak of reward to the next, in constant time a step.

    A segment that ends with a peak is a success; one that grew too long, or that a terminal state ended without a
    peak, is none. What is under way when an episode is cut off from outside is dropped: it might have led to a peak.

    A segment is finished one step after its last: only then it is known that the reward did not climb on.

    Args:
        peaks: Where to cut.
    """

    def __init__(self, peaks: RewardPeaks) -> None:
        super().__init__()
        self.peaks = peaks
        self._before = -math.inf
        self._may_be_peak = False

    def begin(self, observation: Any) -> None:
        """Forget what was recorded, and start an episode in ``observation``."""
        super().begin(observation)
        self._before = -math.inf
        self._may_be_peak = False

    def record(self, action: int, reward: float, observation: Any) -> None:
        """Add one primitive step that led to ``observation``; the one before may turn out to have been a peak."""
        if self._may_be_peak and not reward > self._before:
            self._cut(success=True)
        super().record(action, reward, observation)
        self._may_be_peak = self.peaks.may_peak(reward, self._before)
        self._before = reward
        if len(self) >= self.peaks.max_segment:
            self._cut(success=self._may_be_peak)

    def end(self, *, terminated: bool, truncated: bool, is_success: bool | None) -> None:
        """End the episode, and with it the last segment; what the environment calls success is of no account."""
        if len(self) and (self._may_be_peak or terminated):
            super().end(terminated=terminated, truncated=truncated, is_success=self._may_be_peak)

    def report(self) -> dict[str, Any]:
        """What ``info`` says of what is finished."""
        return {"segments": list(self.finished)}

    def _cut(self, *, success: bool) -> None:
        here = self.last_observation
        super().end(terminated=False, truncated=False, is_success=success)
        self._start(here)
        self._may_be_peak = False
