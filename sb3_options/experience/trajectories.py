"""Trajectories, and the database of the last n of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from sb3_options.experience.observations import FloatArray, IntArray, Observations


@dataclass(frozen=True)
class Trajectory:
    """One episode, or one segment of it, in primitive steps, each distinct observation stored once.

    A random walk revisits few states often, so a long episode stays small. The order of ``states`` is the order of
    first visits, of which a bag is made.

    Attributes:
        states: The distinct observations, in order of first visit; batch of m.
        visits: For every time t = 0 … T the row of ``states`` the agent was in, shape (T + 1,).
        actions: Primitive actions, shape (T,).
        rewards: Undiscounted rewards, shape (T,).
        terminated: Whether it ended in a terminal state.
        truncated: Whether the episode was cut off from outside.
        is_success: ``info["is_success"]`` of the last step; None where the environment does not say. Of a segment:
            whether it ended with a peak of reward (`RewardPeaks`).
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


class EpisodeRecord(NamedTuple):
    """One episode of training, or one segment of a continuing task, in primitive steps.

    Attributes:
        timestep: Primitive steps taken, of all environments, when it ended.
        total_reward: Undiscounted.
        success: As the callback's rule has it.
        steps: Its length.
    """

    timestep: int
    total_reward: float
    success: bool
    steps: int


@dataclass(frozen=True)
class LabelledTrajectory:
    """A trajectory with its features and its label, as discovery needs them.

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

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint: the trajectories, oldest first."""
        return {"trajectories": list(self._trajectories)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Hold what `get_state` gave, and nothing else."""
        self._trajectories.clear()
        self._trajectories.extend(state["trajectories"])
