"""The database of discovery on feature groups: successes, or what stands for them, and failures apart."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from sb3_options.density.groups import FeatureGroup
from sb3_options.experience.observations import BoolArray, take
from sb3_options.experience.trajectories import LabelledTrajectory, TrajectoryDatabase

LEAST_TRAJECTORIES = 16  # nothing is rare among fewer


class Salience:
    """Finds rare events, and counts a failed trajectory as a success up to its rare event.

    Options need bottlenecks, and bottlenecks need successes, which are rare before there are options. A thing that is
    seldom met lies behind something, such as a goal behind a door to open. So paths to it are positive bags until
    enough trajectories have really succeeded. Singh, Barto & Chentanez (2005) proposed salient events as ends of
    options before there is a goal.

    Only groups about a single thing count, those with one set of features in ``present``. A pair is rarer than its
    parts, but no better subgoal.
    """

    STATE = ("rare", "_n", "_successes", "_came")

    def __init__(self, groups: Iterable[FeatureGroup], share: float, enough: int) -> None:
        self.groups = [group for group in groups if len(group.present) == 1]
        self.share = share
        self.enough = enough
        self.rare: tuple[int, ...] = ()
        self._n = 0
        self._successes = 0
        self._came = np.zeros(len(self.groups), dtype=np.int64)

    def add(self, trajectory: LabelledTrajectory) -> bool:
        """Count a trajectory. Return whether the set of rare things has changed."""
        if not self.share or self._successes >= self.enough:
            return False
        self._n += 1
        self._successes += trajectory.success
        seen: BoolArray = np.any(trajectory.features, axis=0)
        came = [seen[list(group.present[0])].any() for group in self.groups]
        self._came += np.array(came, dtype=np.int64)
        before = self.rare
        self.rare = ()
        if self._n >= LEAST_TRAJECTORIES and self._successes < self.enough:
            rare = (self._came > 0) & (self._came <= self.share * self._n)
            self.rare = tuple(np.flatnonzero(rare).tolist())
        return self.rare != before

    def label(self, trajectory: LabelledTrajectory) -> LabelledTrajectory:
        """Return a trajectory as it counts: a failure may count as a success up to its rare event."""
        visits = trajectory.trajectory.visits
        times = []
        for number in () if trajectory.success else self.rare:
            there = self.groups[number].is_place(trajectory.features)
            if there.any() and not there[visits[0]]:
                times.append(int(there[visits].argmax()))
        return _until(trajectory, min(times)) if times else trajectory


class OutcomeDatabase(TrajectoryDatabase):
    """The last ``capacity`` successes and the last ``capacity`` failures, each with its own ``max_bytes``.

    If successes are few, the last trajectories overall hold hardly any. When the set of rare things changes,
    trajectories are labelled again (`Salience`).
    """

    STATE = ("_salience", "n_entered")

    def __init__(self, capacity: int, max_bytes: float, salience: Salience) -> None:
        super().__init__(capacity, max_bytes)
        self._salience = salience
        self.n_entered = 0  # successes added; after relabelling, failures that stand for a success count again

    def add(self, trajectory: LabelledTrajectory) -> None:
        """Append a trajectory, dropping the oldest of its kind if there are too many."""
        if self._salience.add(trajectory):
            wholes = [each.whole or each for each in self._trajectories]
            labelled = [self._salience.label(each) for each in wholes]
            self.n_entered += sum(each.success for each in labelled) - sum(each.success for each in wholes)
            self._replace(labelled)
        self._append(self._salience.label(trajectory))
        self.n_entered += self._trajectories[-1].success

    def kind(self, trajectory: LabelledTrajectory) -> bool:
        """Give successes and failures a capacity each."""
        return trajectory.success

    def __iter__(self) -> Iterator[LabelledTrajectory]:
        """Iterate over failures, then successes, each oldest first."""
        return iter(sorted(self._trajectories, key=lambda each: each.success))


def _until(labelled: LabelledTrajectory, time: int) -> LabelledTrajectory:
    """Return the first ``time`` steps of a trajectory as a success."""
    whole = labelled.trajectory
    n_states = int(whole.visits[: time + 1].max()) + 1
    part = replace(
        whole,
        states=take(whole.states, slice(0, n_states)),
        visits=whole.visits[: time + 1],
        actions=whole.actions[:time],
        rewards=whole.rewards[:time],
        terminated=False,
        truncated=True,
        is_success=None,
    )
    return LabelledTrajectory(part, labelled.features[:n_states], success=True, whole=labelled)
