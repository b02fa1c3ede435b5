"""Trajectories, and the database of the last n of them."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from sb3_options.experience.observations import FeatureMap, FloatArray, IntArray, Observations
from sb3_options.state import storable

logger = logging.getLogger("sb3_options")


@storable
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

    @property
    def n_bytes(self) -> int:
        """What its arrays take."""
        states = [self.states] if isinstance(self.states, np.ndarray) else self.states.values()
        own = sum([array.nbytes for array in states])
        return own + self.visits.nbytes + self.actions.nbytes + self.rewards.nbytes


@storable
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


@storable
@dataclass(frozen=True)
class LabelledTrajectory:
    """A trajectory with its features and its label, as discovery needs them.

    Attributes:
        trajectory: The episode.
        features: φ of ``trajectory.states``, shape (m, d).
        success: Whether its bag is positive.
        whole: What it is a part of, if it is one; its arrays are views of that one's.
    """

    trajectory: Trajectory
    features: FloatArray
    success: bool
    whole: LabelledTrajectory | None = None

    @cached_property
    def n_bytes(self) -> int:
        """What its arrays take, or those that they are views of."""
        return self.trajectory.n_bytes + self.features.nbytes if self.whole is None else self.whole.n_bytes


class TrajectoryDatabase:
    """The last ``capacity`` trajectories, oldest first (McGovern & Barto 2001, Table 1).

    Args:
        capacity: How many trajectories are kept, at least 1.
        max_bytes: How much memory their arrays may take; the last trajectory is kept whatever it takes.

    Raises:
        ValueError: ``capacity`` < 1.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_trajectories", "_n_bytes", "_n_successful")

    def __init__(self, capacity: int, max_bytes: float = math.inf) -> None:
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1 trajectory, got {capacity}.")
        self.capacity, self.max_bytes = capacity, max_bytes
        self._trajectories: deque[LabelledTrajectory] = deque()
        self._n_bytes = self._n_successful = 0
        self._warned = False

    def add(self, trajectory: LabelledTrajectory) -> None:
        """Append, dropping the oldest ones when full. The first time that memory is why, there is a warning."""
        trajectories = self._trajectories
        trajectories.append(trajectory)
        self._n_bytes += trajectory.n_bytes
        self._n_successful += trajectory.success
        if len(trajectories) > self.capacity:
            self._drop_oldest()
        while self._n_bytes > self.max_bytes and len(trajectories) > 1:
            self._drop_oldest()
            if not self._warned:
                self._warned = True
                logger.warning(
                    "The last %d trajectories take all of their memory, %s bytes: fewer than capacity=%d are kept. Let "
                    "the environment give smaller observations.",
                    len(trajectories),
                    f"{self.max_bytes:,}",
                    self.capacity,
                )

    def _drop_oldest(self) -> None:
        oldest = self._trajectories.popleft()
        self._n_bytes -= oldest.n_bytes
        self._n_successful -= oldest.success

    @property
    def n_successful(self) -> int:
        """How many successful ones there are."""
        return self._n_successful

    def embed_again(self, feature_map: FeatureMap) -> None:
        """Give every trajectory the features of another φ; what held the old ones holds them still."""
        for i, old in enumerate(self._trajectories):
            features = feature_map(old.trajectory.states)
            self._trajectories[i] = LabelledTrajectory(old.trajectory, features, old.success)
        self._n_bytes = sum(each.n_bytes for each in self._trajectories)
        self._n_successful = sum(each.success for each in self._trajectories)

    def clear(self) -> None:
        """Drop all."""
        self._trajectories.clear()
        self._n_bytes = self._n_successful = 0

    def __len__(self) -> int:
        return len(self._trajectories)

    def __iter__(self) -> Iterator[LabelledTrajectory]:
        return iter(self._trajectories)
