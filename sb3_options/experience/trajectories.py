"""What the agent has lived through: recording a trajectory, and the database of the last n of them."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import FloatArray, IntArray, Observations

logger = logging.getLogger("sb3_options")


@dataclass(frozen=True)
class Trajectory:
    """One episode, or one segment of it, in primitive steps, each distinct observation stored once.

    A random walk revisits few states often, so that storing each once keeps a long episode small; and the order
    of ``states`` is the order of first visits, which is what a bag is made of.

    Attributes:
        states: The distinct observations, in order of first visit; batch of m.
        visits: For every time t = 0 … T the row of ``states`` the agent was in, shape (T + 1,).
        actions: Primitive actions, shape (T,).
        rewards: Undiscounted rewards, shape (T,).
        terminated: Whether it ended in a terminal state.
        truncated: Whether the episode was cut off from outside.
        is_success: ``info["is_success"]`` of the last step; None where the environment does not say. Of a segment:
            whether it ended with a peak of reward (`continuing`).
    """

    states: Observations
    visits: IntArray
    actions: IntArray
    rewards: FloatArray
    terminated: bool
    truncated: bool
    is_success: bool | None

    def __len__(self) -> int:
        """Duration T in primitive steps."""
        return len(self.actions)


LONGEST_EPISODE = 100_000
"""Primitive steps of an episode that are recorded. What never ends must not fill the memory."""


class TrajectoryRecorder:
    """Builds a `Trajectory` while an episode runs, in constant time a step.

    Attributes:
        finished: What is complete, oldest first; whoever takes it clears it.
    """

    def __init__(self) -> None:
        self.finished: list[Trajectory] = []
        self._forget()

    def __len__(self) -> int:
        """Primitive steps recorded of the trajectory under way."""
        return len(self._actions)

    @property
    def last_observation(self) -> Any:
        """Where the trajectory under way has come to."""
        return self._states[self._visits[-1]]

    def begin(self, observation: Any) -> None:
        """Forget what was recorded, and start an episode in ``observation``."""
        self.finished.clear()
        self._start(observation)

    def record(self, action: int, reward: float, observation: Any) -> None:
        """Add one primitive step that led to ``observation``."""
        self._actions.append(action)
        self._rewards.append(reward)
        self._visit(observation)

    def end(self, *, terminated: bool, truncated: bool, is_success: bool | None) -> None:
        """Complete the episode as a `Trajectory`."""
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
        """What ``info`` says of what is finished."""
        return {"trajectory": self.finished[-1]}

    def _forget(self) -> None:
        self._row_of: dict[bytes, int] = {}
        self._states: list[Any] = []
        self._visits: list[int] = []
        self._actions: list[int] = []
        self._rewards: list[float] = []

    def _start(self, observation: Any) -> None:
        self._forget()
        self._visit(observation)

    def _visit(self, observation: Any) -> None:
        row = self._row_of.setdefault(obs_batch.key_of(observation), len(self._states))
        if row == len(self._states):
            self._states.append(obs_batch.copy_of(observation))
        self._visits.append(row)


class EpisodeRecorder(TrajectoryRecorder):
    """Records episodes whole, as long as they end.

    One that has come to `LONGEST_EPISODE` steps is forgotten, and a warning says what to do.
    """

    def __init__(self) -> None:
        super().__init__()
        self._gave_up = False

    def begin(self, observation: Any) -> None:
        """Forget what was recorded, and start an episode in ``observation``."""
        super().begin(observation)
        self._gave_up = False

    def record(self, action: int, reward: float, observation: Any) -> None:
        """Add one primitive step that led to ``observation``."""
        if self._gave_up:
            return
        super().record(action, reward, observation)
        if len(self) == LONGEST_EPISODE:
            self._gave_up = True
            self._forget()
            logger.warning(
                "An episode has not ended after %d primitive steps and is no longer recorded: no subgoals can be "
                "discovered in it. Give the environment a time limit, or cut experience at peaks of reward "
                "(DiscoverySettings(segmentation='peaks'); train.py --discovery.segmentation peaks).",
                LONGEST_EPISODE,
            )

    def end(self, *, terminated: bool, truncated: bool, is_success: bool | None) -> None:
        """Complete the episode as a `Trajectory`, unless it was too long."""
        if not self._gave_up:
            super().end(terminated=terminated, truncated=truncated, is_success=is_success)


@dataclass(frozen=True)
class LabelledTrajectory:
    """A trajectory with what discovery needs to know of it.

    Attributes:
        trajectory: The episode.
        features: φ of ``trajectory.states``, shape (m, d).
        success: Whether its bag is positive.
    """

    trajectory: Trajectory
    features: FloatArray
    success: bool


class TrajectoryDatabase:
    """The last ``capacity`` trajectories, oldest first (McGovern & Barto 2001, Table 1).

    Args:
        capacity: How many trajectories are kept, at least 1.

    Raises:
        ValueError: ``capacity`` < 1.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1 trajectory, got {capacity}.")
        self._trajectories: deque[LabelledTrajectory] = deque(maxlen=capacity)

    def add(self, trajectory: LabelledTrajectory) -> None:
        """Append, dropping the oldest one when full."""
        self._trajectories.append(trajectory)

    def __len__(self) -> int:
        return len(self._trajectories)

    def __iter__(self) -> Iterator[LabelledTrajectory]:
        return iter(self._trajectories)
