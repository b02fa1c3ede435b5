"""Discovery on groups of features: for each group the bags, the peaks and the subgoals of its own features."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.bag_maker import BagMaker
from sb3_options.discovery.budget import seconds_of_contrast
from sb3_options.discovery.contrast import Contrast
from sb3_options.discovery.subgoals import Search, SubgoalDiscovery
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory, TrajectoryDatabase

SEARCH_GROWTH = 0.05
"""A search waits until this share of the successful trajectories is new: fewer hardly change what is common to all."""


class OutcomeDatabase(TrajectoryDatabase):
    """The last ``capacity`` successful trajectories and as many of the others.

    Where few trajectories succeed, the last ones of all hardly hold any that did.

    Args:
        capacity: Of each kind, at least 1.
        max_bytes: Likewise.

    Raises:
        ValueError: ``capacity`` < 1.
    """

    def __init__(self, capacity: int, max_bytes: float = math.inf) -> None:
        super().__init__(capacity, max_bytes)
        self._successful = TrajectoryDatabase(capacity, max_bytes)

    def add(self, trajectory: LabelledTrajectory) -> None:
        """Append, dropping the oldest one of its kind when there are too many."""
        if trajectory.success:
            self._successful.add(trajectory)
        else:
            super().add(trajectory)

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint: the trajectories of each kind, oldest first."""
        return {**super().get_state(), "successful": self._successful.get_state()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Hold what `get_state` gave, and nothing else."""
        super().set_state(state)
        self._successful.set_state(state["successful"])

    @property
    def n_successful(self) -> int:
        """How many successful ones there are."""
        return len(self._successful)

    def __len__(self) -> int:
        return super().__len__() + len(self._successful)

    def __iter__(self) -> Iterator[LabelledTrajectory]:
        """The unsuccessful ones, then the successful ones, each oldest first."""
        return chain(super().__iter__(), self._successful)


@dataclass
class GroupedDiscovery(SubgoalDiscovery):
    """`SubgoalDiscovery` once for each group of features; a subgoal says nothing of the features of other groups.

    A bag holds the places of its group that the trajectory visited, in the group's own features; `start_radius`,
    `goal_radius` and `spacing` count in these. It holds all of them: seen from an agent that moves, the same state
    twice need not be a loop (``loops``), nor do ways lead through it (``min_passing``). Instead an instance of a
    successful trajectory must stand out by its `Contrast`. There is a search when a trajectory has succeeded, and later
    when a few have (`SEARCH_GROWTH`).

    Args:
        groups: Of features, at least one.
    """

    groups: tuple[FeatureGroup, ...] = ()

    def __post_init__(self) -> None:
        """Set up what grows with experience, for each group."""
        super().__post_init__()
        self.database: OutcomeDatabase = OutcomeDatabase(self.settings.capacity, self.settings.max_bytes)
        own = replace(self.settings, loops="keep", min_passing=0.0)
        contrasts: dict[FeatureGroup, Contrast] = {}
        for group in sorted(self.groups, key=lambda group: len(group.features)):
            parts = [c for part, c in contrasts.items() if set(part.features) < set(group.features)]
            contrasts[group] = Contrast(group, own.subgoal_radius, parts, equal_time=own.equal_time)
        self._contrasts = contrasts
        self._maker = BagMaker(own, self.static_filter, self.kind)  # it makes no bags: its members do
        self.members: dict[FeatureGroup, SubgoalDiscovery] = {}
        for group in self.groups:
            taken = [region for region in self.taken if region.group == group]
            member = SubgoalDiscovery(own, self.success, self.static_filter, self.kind, taken, group=group)
            member.database = self.database
            member._maker = BagMaker(own, self.static_filter, self.kind, group, contrasts[group])
            self.members[group] = member
        self._new_successes = 0

    @property
    def scale(self) -> FloatArray | None:
        """None: every group has its own."""
        return None

    def add(self, trajectory: Trajectory, features: FloatArray, *, success: bool | None = None) -> LabelledTrajectory:
        """Put a trajectory into the database; as `SubgoalDiscovery.add`."""
        labelled = super().add(trajectory, features, success=success)
        self._new_successes += labelled.success
        return labelled

    def search(self) -> Region | None:
        """Search the bags of every group once, if enough trajectories have succeeded since the last search.

        Returns:
            A new subgoal, if a concept has become persistent, of the group with the largest contrast. The others that
            are persistent come with later searches.
        """
        n_positive = self.database.n_successful
        if self._new_successes < max(1.0, SEARCH_GROWTH * n_positive):
            return None
        if not self.budget.affords():
            return None
        self._new_successes = 0
        began = time.perf_counter()
        if n_positive >= self.settings.min_positive:
            trajectories = list(self.database)
            for contrast in self._contrasts.values():
                contrast.update(trajectories)
            for group, member in self.members.items():
                if self._contrasts[group].largest() >= self.settings.min_contrast:
                    member.update()
                    self.budget.spent += member.cost
            self.budget.spent += sum(
                seconds_of_contrast(len(trajectories), contrast.n_states) for contrast in self._contrasts.values()
            )
        best = max(self.members.values(), key=lambda m: m.leading_average(), default=None)
        seconds = time.perf_counter() - began
        self.last = Search([], None, seconds) if best is None else best.last._replace(seconds=seconds)
        if best is not None:
            self.tracker = best.tracker
        self.seconds += seconds
        return self._new_subgoal()

    def _new_subgoal(self) -> Region | None:
        for member in self.members.values():
            subgoal = member._new_subgoal()
            if subgoal is not None:
                self.found.append(member.found[-1])
                return subgoal
        return None

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            **super().get_state(),
            "contrasts": [contrast.get_state() for contrast in self._contrasts.values()],
            "members": [member.get_state() for member in self.members.values()],
            "leading": [member.tracker is self.tracker for member in self.members.values()],
            "new_successes": self._new_successes,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        super().set_state(state)
        for contrast, of_contrast in zip(self._contrasts.values(), state["contrasts"], strict=True):
            contrast.set_state(of_contrast)
        for member, of_member, leads in zip(self.members.values(), state["members"], state["leading"], strict=True):
            member.set_state(of_member)  # each holds the same database
            if leads:
                self.tracker = member.tracker
        self._new_successes = state["new_successes"]

    def why_nothing(self) -> str:
        """Why there is no option, in a sentence."""
        enough = self.outcomes.successes >= self.settings.min_positive
        if (
            not self.found
            and enough
            and all(c.largest() < self.settings.min_contrast for c in self._contrasts.values())
        ):
            return (
                "No subgoal was discovered: successful trajectories visit no state of a group of features much oftener "
                f"than the others do; min_contrast is {self.settings.min_contrast:g}."
            )
        return super().why_nothing()
