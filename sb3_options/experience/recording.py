"""Recording trajectories: whole episodes, or, in a continuing task, segments between peaks of reward.

McGovern & Barto (2001) make bags of episodes. A task that never ends, or whose episodes are only cut off by time, has
no such episodes. Its experience is segmented at peaks of reward (after Iba 1989): the steps between two peaks are a
successful trajectory.
"""

import logging
import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import FloatArray, IntArray, Observations
from sb3_options.experience.trajectories import Trajectory

logger = logging.getLogger("sb3_options")

LONGEST_EPISODE = 100_000
"""Most recorded primitive steps of an episode: an episode that never ends would fill the memory."""


class TrajectoryRecorder:
    """Builds a `Trajectory` of each episode while it runs, in constant time per step.

    An episode of more than `LONGEST_EPISODE` steps is dropped with a warning.
    """

    def __init__(self) -> None:
        self.finished: list[Trajectory] = []  # oldest first; whoever takes them clears the list
        self._forget()
        self._gave_up = False

    def __len__(self) -> int:
        """Primitive steps recorded of the unfinished trajectory."""
        return len(self._actions)

    def begin(self, observation: Any) -> None:
        """Forget the recording, and start an episode in ``observation``."""
        self.finished.clear()
        self._start(observation)
        self._gave_up = False

    def record(self, action: int, reward: float, observation: Any, key: bytes | None = None) -> None:
        """Add one primitive step that led to ``observation``, with its `key_of` if that is known."""
        if len(self._actions) == LONGEST_EPISODE:
            self._gave_up = True
            self._forget()
            logger.warning(
                "An episode has not ended after %d primitive steps and is no longer recorded: no subgoals can be "
                "discovered in it. Give the environment a time limit, or cut experience at peaks of reward "
                "(DiscoverySettings(segmentation='peaks'); train.py --discovery.segmentation peaks).",
                LONGEST_EPISODE,
            )
        if not self._gave_up:
            self._actions.append(action)
            self._rewards.append(reward)
            self._visit(observation, key)

    def end(self, *, terminated: bool, truncated: bool, is_success: bool | None) -> None:
        """Complete the episode as a `Trajectory`, unless it was too long."""
        if self._gave_up:
            return
        self.finished.append(
            Trajectory(
                states=obs_batch.stack(self._states),
                visits=np.array(self._visits, dtype=np.int64),
                actions=np.array(self._actions, dtype=np.int64),
                rewards=np.array(self._rewards, dtype=np.float64),
                terminated=terminated,
                truncated=truncated,
                is_success=is_success,
            )
        )
        self._forget()

    def report(self) -> dict[str, Any]:
        """Return the finished trajectory as an entry of ``info``."""
        return {"trajectory": self.finished[-1]}

    def _forget(self) -> None:
        self._row_of: dict[bytes, int] = {}
        self._states: list[Any] = []
        self._visits: list[int] = []
        self._actions: list[int] = []
        self._rewards: list[float] = []

    def get_state(self) -> dict[str, Any]:
        """Return the unfinished trajectory, for a checkpoint. Finished ones were taken when their step ended."""
        return {
            "states": obs_batch.stack(self._states) if self._states else None,
            "visits": np.array(self._visits, dtype=np.int64),
            "actions": np.array(self._actions, dtype=np.int64),
            "rewards": np.array(self._rewards, dtype=np.float64),
            "gave_up": self._gave_up,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state from `get_state`."""
        self.finished.clear()
        self._forget()
        states = state["states"]
        if states is not None:
            self._states = [obs_batch.copy_of(obs_batch.take(states, i)) for i in range(obs_batch.batch_size(states))]
        self._row_of = {obs_batch.key_of(each): row for row, each in enumerate(self._states)}
        self._visits, self._actions = state["visits"].tolist(), state["actions"].tolist()
        self._rewards = state["rewards"].tolist()
        self._gave_up = state["gave_up"]

    def _start(self, observation: Any) -> None:
        self._forget()
        self._visit(observation)

    def _visit(self, observation: Any, key: bytes | None = None) -> None:
        row = self._row_of.setdefault(key or obs_batch.key_of(observation), len(self._states))
        if row == len(self._states):
            self._states.append(obs_batch.copy_of(observation))
        self._visits.append(row)


class SegmentRecorder(TrajectoryRecorder):
    """Builds a `Trajectory` from each peak of reward to the next, in constant time per step.

    A segment that ends with a peak succeeded. A segment that became too long, or ended in a terminal state without a
    peak, failed. If an episode is truncated, its unfinished segment is dropped: it might have led to a peak.

    Step t is a peak if r_t > 0 and r_{t−1} < r_t ≥ r_{t+1}, with r = −∞ before an episode and after it. So a reward
    that rises over several steps has one peak, at its maximum. A reward that stays high has one peak, at its first
    step. A segment is finished one step after its last, because only then the reward is known not to rise further.

    A segment of ``max_segment`` primitive steps without a peak is cut, and failed: no more are held in memory.
    """

    def __init__(self, max_segment: int) -> None:
        super().__init__()
        self.max_segment = max_segment
        self._before = -math.inf
        self._may_be_peak = False

    def begin(self, observation: Any) -> None:
        """Forget the recording, and start an episode in ``observation``."""
        super().begin(observation)
        self._before = -math.inf
        self._may_be_peak = False

    def record(self, action: int, reward: float, observation: Any, key: bytes | None = None) -> None:
        """Add one primitive step that led to ``observation``; the step before may turn out to be a peak."""
        if self._may_be_peak:
            if not reward > self._before:
                self._cut(success=True)
            elif self._is_full():
                self._cut(success=False)
        super().record(action, reward, observation, key)
        self._may_be_peak = reward > max(0.0, self._before)
        self._before = reward
        if self._is_full() and not self._may_be_peak:
            self._cut(success=False)

    def end(self, *, terminated: bool, truncated: bool, is_success: bool | None) -> None:
        """End the episode and its last segment; the environment's own success does not count."""
        if len(self) and (self._may_be_peak or terminated):
            super().end(terminated=terminated, truncated=truncated, is_success=self._may_be_peak)

    def report(self) -> dict[str, Any]:
        """Return the finished segments as an entry of ``info``."""
        return {"segments": list(self.finished)}

    def get_state(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        return {**super().get_state(), "before": self._before, "may_be_peak": self._may_be_peak}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state from `get_state`."""
        super().set_state(state)
        self._before = state["before"]
        self._may_be_peak = state["may_be_peak"]

    def _is_full(self) -> bool:
        return len(self._actions) >= self.max_segment

    def _cut(self, *, success: bool) -> None:
        here = self._states[self._visits[-1]]
        super().end(terminated=False, truncated=False, is_success=success)
        self._start(here)
        self._may_be_peak = False


def logged_trajectory(
    observations: Observations | Sequence[Any],
    actions: Sequence[int] | IntArray,
    rewards: Sequence[float] | FloatArray,
    *,
    terminated: bool,
    is_success: bool | None = None,
) -> Trajectory:
    """Make a trajectory of an episode in a log or a data set, such as Minari's.

    Args:
        observations: T + 1 observations as the environment returns them; for a dictionary space one dictionary of
            arrays.
        actions: T primitive actions, whole numbers.
        rewards: T undiscounted rewards.
        terminated: Whether the episode ended in a terminal state. Otherwise it was truncated.
        is_success: Whether it succeeded; by default the rule of ``SubgoalDiscoveryCallback(success=…)`` decides.

    Raises:
        ValueError: The lengths do not fit, or T is 0 or above `LONGEST_EPISODE`.
        TypeError: An action is not a whole number.
    """
    batch: Any = observations if isinstance(observations, Mapping) else np.asarray(observations)
    n_actions, n_rewards, n_observations = len(actions), len(rewards), obs_batch.batch_size(batch)
    if not 1 <= n_actions == n_rewards == n_observations - 1 <= LONGEST_EPISODE:
        given = f"{n_actions}, {n_rewards} and {n_observations}"
        raise ValueError(f"Give T actions, T rewards, T + 1 observations, 1 ≤ T ≤ {LONGEST_EPISODE:,}; got {given}.")
    recorder = TrajectoryRecorder()
    recorder.begin(obs_batch.take(batch, 0))
    for time, (action, reward) in enumerate(zip(actions, rewards, strict=True), start=1):
        recorder.record(operator.index(action), float(reward), obs_batch.take(batch, time))
    recorder.end(terminated=terminated, truncated=not terminated, is_success=is_success)
    return recorder.finished[0]
