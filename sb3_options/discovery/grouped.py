"""Discovery on groups of features: for each group the bags, the peaks and the subgoals of its own features."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.bag_maker import BagMaker
from sb3_options.discovery.budget import seconds_of_contrast
from sb3_options.discovery.contrast import Contrast
from sb3_options.discovery.found import Search
from sb3_options.discovery.outcome_database import OutcomeDatabase
from sb3_options.discovery.salience import Salience
from sb3_options.discovery.subgoals import SubgoalDiscovery
from sb3_options.experience.observations import FloatArray


@dataclass
class GroupedDiscovery(SubgoalDiscovery):
    """`SubgoalDiscovery` once for each group of features; a subgoal says nothing of the features of other groups.

    A bag holds the places of its group that the trajectory visited, in the group's own features; `start_radius`,
    `goal_radius` and `spacing` count in these. It holds all of them: seen from an agent that moves, the same state
    twice need not be a loop (``loops``), nor do ways lead through it (``min_passing``). Instead an instance of a
    successful trajectory must stand out by its `Contrast`. There is a search when a trajectory has succeeded, and later
    when a few have (``search_growth``). Until enough have, what came upon something rare may count as one (`Salience`).

    Args:
        groups: Of features, at least one.
    """

    LEADS: ClassVar[str] = "leads surely enough (min_reach)"

    groups: tuple[FeatureGroup, ...] = ()

    def __post_init__(self) -> None:
        """Set up what grows with experience, for each group."""
        of_groups = self.taken
        super().__post_init__()
        self.outcomes.needed = self.settings.salient_share == 0
        salience = Salience(self.groups, self.settings.salient_share, self.settings.min_positive)
        self.database: OutcomeDatabase = OutcomeDatabase(self.settings.capacity, self.settings.max_bytes, salience)
        own = replace(self.settings, loops="keep", min_passing=0.0)
        contrasts: dict[FeatureGroup, Contrast] = {}
        for group in sorted(self.groups, key=lambda group: len(group.features)):
            parts = [c for part, c in contrasts.items() if set(part.features) < set(group.features)]
            contrasts[group] = Contrast(
                group, own.subgoal_radius / (own.scale or 1.0), parts, equal_time=own.equal_time
            )
        self._contrasts = contrasts
        self._maker = BagMaker(own, self.static_filter, self.kind)  # it makes no bags: its members do
        self.members: dict[FeatureGroup, SubgoalDiscovery] = {}
        for group in self.groups:
            taken = [region for region in of_groups if region.group == group]
            member = SubgoalDiscovery(own, self.success, self.static_filter, self.kind, taken, group=group)
            member.database = self.database
            member._maker = BagMaker(own, self.static_filter, self.kind, group, contrasts[group])
            self.members[group] = member
        self._searched = 0

    @property
    def scale(self) -> FloatArray | None:
        """None: every group has its own."""
        return None

    def search(self) -> Region | None:
        """Search the bags of every group once, if enough trajectories have succeeded since the last search.

        Returns:
            A new subgoal, if a concept has become persistent, of the first group that has one. The others that are
            persistent come with later searches.
        """
        n_positive = self.database.n_successful
        if self.database.n_entered - self._searched < max(1.0, self.settings.search_growth * n_positive):
            return None
        if not self.budget.affords():
            return None
        self._searched = self.database.n_entered
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
        best = max(self.members.values(), key=lambda m: m.tracker.leading_average(), default=None)
        seconds = time.perf_counter() - began
        self.last = Search([], None, seconds) if best is None else best.last._replace(seconds=seconds)
        if best is not None:
            self.tracker = best.tracker
        self.seconds += seconds
        return self._new_subgoal()

    def withdraw(self) -> None:
        """Say that there is no option for the last subgoal yet: with more trajectories it may come again."""
        super().withdraw()
        group = self.found.pop().subgoal.group
        assert group is not None  # all subgoals here have one
        self.members[group].found.pop()
        self.members[group]._maker.forget_bags()

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
            "searched": self._searched,
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
        self._searched = state["searched"]

    @property
    def n_kept(self) -> int:
        """Subgoals found that there is an option for; what was withdrawn is no longer among those found."""
        return len(self.found)

    def why_nothing(self) -> str:
        """Why there is no option, in a sentence; where there are some, that there are."""
        enough = self._n_positive >= self.settings.min_positive
        if (
            not self.found
            and enough
            and all(c.largest() < self.settings.min_contrast for c in self._contrasts.values())
        ):
            return (
                "No subgoal was discovered: successful trajectories visit no state of a group of features much oftener "
                f"than the others do; min_contrast is {self.settings.min_contrast:g}.{self._stood_for_successes()}"
            )
        return super().why_nothing()

    @property
    def _n_positive(self) -> int:
        return self.database.n_successful

    def _stood_for_successes(self) -> str:
        n = sum(each.whole is not None for each in self.database)
        if not n:
            return ""
        stood = "failure that came upon something rare stands for a success"
        if n > 1:
            stood = "failures that came upon something rare stand for successes"
        return f" {n} {stood} (salient_share)."
