"""Trajectories, and the database of the last n of them."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from sb3_options.experience.observations import FeatureMap, FloatArray, IntArray, Observations
from sb3_options.state import restore, storable

logger = logging.getLogger("sb3_options")


@storable
@dataclass(frozen=True)
class Trajectory:
    """One episode, or one segment of it, in primitive steps, each distinct observation stored once.

    A random walk revisits few states often, so a long episode stays small. ``states`` are in the order of first visits;
    a bag is made of them.

    Attributes:
        states: The distinct observations, in order of first visit; batch of m.
        visits: For every time t = 0 … T the row of ``states`` the agent was in, shape (T + 1,).
        actions: Primitive actions, shape (T,).
        rewards: Undiscounted rewards, shape (T,).
        terminated: Whether it ended in a terminal state.
        truncated: Whether the episode was cut off from outside.
        is_success: ``info["is_success"]`` of the last step; None if the environment does not report it. For a segment:
            whether it ended with a peak of reward (`SegmentRecorder`).
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

    @cached_property
    def arrivals(self) -> IntArray:
        """Times when the agent first came to each of the ``states``, (m,)."""
        return np.unique(self.visits, return_index=True)[1]

    @property
    def n_bytes(self) -> int:
        """Memory of its arrays, in bytes."""
        states = [self.states] if isinstance(self.states, np.ndarray) else self.states.values()
        own = sum([array.nbytes for array in states])
        return own + self.visits.nbytes + self.actions.nbytes + self.rewards.nbytes


@storable
class EpisodeRecord(NamedTuple):
    """One episode of training, or one segment of a continuing task, in primitive steps.

    Attributes:
        timestep: Primitive steps taken, of all environments, when it ended.
        total_reward: Undiscounted sum of rewards.
        success: Success by the callback's rule.
        steps: Length.
    """

    timestep: int
    total_reward: float
    success: bool
    steps: int


@storable
@dataclass(frozen=True, eq=False)
class LabelledTrajectory:
    """A trajectory with its features and its label, as discovery needs them.

    Attributes:
        trajectory: The episode.
        features: φ of ``trajectory.states``, shape (m, d).
        success: Whether its bag is positive.
        whole: The trajectory that it is a part of, if any; its arrays are views of that one's.
    """

    trajectory: Trajectory
    features: FloatArray
    success: bool
    whole: LabelledTrajectory | None = None

    @cached_property
    def n_bytes(self) -> int:
        """Memory of its arrays, or of the arrays that they are views of, in bytes."""
        return self.trajectory.n_bytes + self.features.nbytes if self.whole is None else self.whole.n_bytes


class TrajectoryDatabase:
    """The last ``capacity`` trajectories, oldest first (McGovern & Barto 2001, Table 1).

    Their arrays take at most ``max_bytes``, but the last trajectory is always kept. ``n_successful`` were successful.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_trajectories",)

    def __init__(self, capacity: int, max_bytes: float = math.inf) -> None:
        self.capacity = capacity
        self.max_bytes = max_bytes
        self._warned = False
        self._replace(())

    def kind(self, trajectory: LabelledTrajectory) -> bool:
        """Return the kind of a trajectory: each has its own capacity. Here all are of one kind."""
        return False

    def add(self, trajectory: LabelledTrajectory) -> None:
        """Append a trajectory; drop the oldest ones of its kind if there are too many, or if they are too large."""
        self._append(trajectory)

    def _append(self, trajectory: LabelledTrajectory) -> None:
        kind = self.kind(trajectory)
        self._trajectories.append(trajectory)
        self._count(trajectory, 1)
        while self._n[kind] > self.capacity or (self._n_bytes[kind] > self.max_bytes and self._n[kind] > 1):
            for_memory = self._n[kind] <= self.capacity
            i = next(i for i, each in enumerate(self._trajectories) if self.kind(each) is kind)
            self._count(self._trajectories.pop(i), -1)
            if for_memory and not self._warned:
                self._warned = True
                logger.warning(
                    "The last %d trajectories take all of their memory, %s bytes: fewer than capacity=%d are kept. Let "
                    "the environment give smaller observations.",
                    self._n[kind],
                    f"{self.max_bytes:,}",
                    self.capacity,
                )

    def _count(self, trajectory: LabelledTrajectory, n: int) -> None:
        kind = self.kind(trajectory)
        self._n[kind] += n
        self._n_bytes[kind] += n * trajectory.n_bytes
        self.n_successful += n * trajectory.success

    def _replace(self, trajectories: Iterable[LabelledTrajectory]) -> None:
        """Hold these trajectories instead."""
        every = list(trajectories)
        self._trajectories: list[LabelledTrajectory] = []
        self._n: Counter[bool] = Counter()  # by kind
        self._n_bytes: Counter[bool] = Counter()
        self.n_successful = 0
        for each in every:
            self._append(each)

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state, and count its trajectories."""
        restore(self, state)
        self._replace(self._trajectories)

    def embed_again(self, feature_map: FeatureMap) -> None:
        """Give every trajectory the features of another φ, in new objects: others may hold the old ones."""
        self._replace(
            LabelledTrajectory(old.trajectory, feature_map(old.trajectory.states), old.success)
            for old in self._trajectories
        )

    def __len__(self) -> int:
        return len(self._trajectories)

    def __iter__(self) -> Iterator[LabelledTrajectory]:
        return iter(self._trajectories)
