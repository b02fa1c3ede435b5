"""Discovery by another method than diverse density: its proposals, filtered and taken one by one."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.found import FoundSubgoal, Search
from sb3_options.discovery.grouped import GroupedDiscovery
from sb3_options.discovery.methods import METHODS, DiscoveryMethod, Experience, Proposal, method_named, proposed_by
from sb3_options.discovery.methods.method import kept, seconds_by
from sb3_options.discovery.random_grouped import RandomGroupedDiscovery
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.discovery.static_filter import steps_from
from sb3_options.discovery.subgoals import SubgoalDiscovery
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.options.proposals import goal_of

logger = logging.getLogger("sb3_options")

TELL_SECONDS, UPDATE_SECONDS, FEATURE_SECONDS = 3.6e-4, 5e-7, 2e-8
"""Nominal time of telling a method of a trajectory, and for each of its steps, and each feature of each state."""


@dataclass
class ProposedDiscovery(SubgoalDiscovery):
    """`SubgoalDiscovery` whose subgoals a method proposes.

    The static filter, `spacing`, `subgoal_radius`, `scale` and `capacity` of the settings hold as for diverse density;
    the others are diverse density's own.

    Args:
        method: Which.
    """

    method: DiscoveryMethod = field(kw_only=True)

    def __post_init__(self) -> None:
        """Set up what grows with experience."""
        super().__post_init__()
        self._maker.cuts = None  # no bags are made
        self.outcomes.needed = getattr(self.method, "needs_success", False)
        self._untold: list[LabelledTrajectory] = []
        self._proposals: list[Proposal] = []
        self._withdrawn: list[tuple[Region, int]] = []  # and after how many trajectories

    def add(self, trajectory: Trajectory, features: FloatArray, *, success: bool | None = None) -> LabelledTrajectory:
        """Put a trajectory into the database, and tell the method with the next search; as `SubgoalDiscovery.add`."""
        labelled = super().add(trajectory, features, success=success)
        self._untold = [*self._untold, labelled][-self.settings.capacity :]
        while len(self._untold) > 1 and sum(each.n_bytes for each in self._untold) > self.settings.max_bytes:
            del self._untold[0]
        return labelled

    def search(self) -> Region | None:
        """Tell the method what is new, and take a proposal; as `SubgoalDiscovery.search`.

        Returns:
            Where it leads; `found` has the proposal. What the budget does not afford the method is never told.
        """
        skipped = self.budget.skipped
        subgoal = super().search()
        if self.budget.skipped > skipped and self.scale is not None:
            self._untold = []
        return subgoal

    def _is_due(self) -> bool:
        """Always: the method is told of every trajectory when it has ended."""
        return True

    def update(self) -> None:
        """Tell the method what is new; nothing as long as the scale of the features is not known."""
        began = time.perf_counter()
        self.cost = 0.0
        if self._maker.knows_scale(self.database, self.outcomes.n):
            earlier: list[Proposal] = []
            while self._untold:
                experience = self._experience(self._untold.pop(0))  # a method that fails is not told again
                worked = time.process_time()
                self._proposals = [*proposed_by(self.method, experience), *earlier]
                worked = time.process_time() - worked
                earlier = self._proposals
                self.cost += TELL_SECONDS + UPDATE_SECONDS * (len(experience.visits) - 1)
                self.cost += FEATURE_SECONDS * experience.features.size
                said = seconds_by(self.method, experience)
                self.cost += worked if said is None else said
            if self.recurrence.is_due(len(self.database)):
                self._look()
        self.last = Search([], None, time.perf_counter() - began)
        self.seconds += self.last.seconds

    def _look(self) -> None:
        """Look whether anything recurs; the method is told all the same."""
        assert self.scale is not None  # known before the method is told anything
        lived = [labelled.features * self.scale for labelled in self.database]
        ways = [
            way[self._maker.may_be_subgoals(labelled, [])] for way, labelled in zip(lived, self.database, strict=True)
        ]
        self.cost += self.recurrence.look(ways, len(ways), f"{self.outcomes.unit}s")

    def _experience(self, labelled: LabelledTrajectory) -> Experience:
        assert self.scale is not None  # known before the method is told anything
        taken = [*self.taken, *(found.subgoal for found in self.found)]
        allowed = self._maker.may_be_subgoals(labelled, taken)
        return Experience(
            labelled.features,
            labelled.trajectory.visits,
            success=labelled.success,
            allowed=allowed,
            scale=self.scale,
            radius=self.settings.subgoal_radius,
            taken=taken,
            trajectory=labelled.trajectory,
        )

    def _new_subgoal(self) -> Region | None:
        known = [*self.taken, *(found.subgoal for found in self.found)]
        for given in self._proposals:
            goal = goal_of(given)
            if self._is_apart(goal, known) and not self._waits(goal):
                self._proposals = []
                proposal = kept(given, self.method)
                goal = goal_of(proposal)
                self.found.append(FoundSubgoal(goal, None, math.nan, None if goal is proposal else proposal))
                return goal
        return None

    def withdraw(self) -> None:
        """Say that there is no option for the last proposal yet; it may come again after twice as many trajectories."""
        super().withdraw()
        goal = self.found.pop().subgoal
        self._withdrawn = [each for each in self._withdrawn if not np.array_equal(each[0].points, goal.points)]
        self._withdrawn.append((goal, self.outcomes.n))

    def _waits(self, goal: Region) -> bool:
        """Whether there was no option for this place, after more than half as many trajectories as by now."""
        waiting = [region for region, n in self._withdrawn if self.outcomes.n < 2 * n]
        return any(region.contains(goal.points[:1]).any() for region in waiting)

    @property
    def n_kept(self) -> int:
        """Subgoals found that there is an option for; what was withdrawn is no longer among those found."""
        return len(self.found)

    @property
    def learns_from_failures(self) -> bool:
        """Always: methods are told of every trajectory."""
        return True

    def _is_apart(self, goal: Region, known: Sequence[Region]) -> bool:
        """Whether a subgoal is farther than `spacing` from all others.

        Where states have no distances, steps count along the last trajectory that came to the subgoal.
        """
        assert self.scale is not None  # known before anything is proposed
        if not self._maker.counts_steps:
            away = [np.linalg.norm((goal.points[:1] - other.points[:1]) * self.scale, axis=1) for other in known]
            return all((distances > self.settings.spacing).all() for distances in away)
        if any(np.array_equal(goal.points[:1], other.points[:1]) for other in known):
            return False
        for labelled in reversed(list(self.database)):
            at = np.flatnonzero(goal.contains(labelled.features))
            if len(at):
                others = [np.flatnonzero(other.contains(labelled.features)) for other in known]
                visits = labelled.trajectory.visits
                return all(steps_from(rows, visits)[at].min() > self.settings.spacing for rows in others if len(rows))
        return True

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint.

        Raises:
            ValueError: The method does not tell what it remembers.
        """
        if not (hasattr(self.method, "get_state") and hasattr(self.method, "set_state")):
            raise ValueError(
                f"Checkpoints of discovery by {type(self.method).__name__} are not supported: give it get_state() and "
                "set_state(state)."
            )
        return {
            **super().get_state(),
            "method": self.method.get_state(),
            "untold": self._untold,
            "proposals": self._proposals,
            "withdrawn": self._withdrawn,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        super().set_state(state)
        self._untold, self._proposals = state["untold"], state["proposals"]
        self._withdrawn = [(region, n) for region, n in state.get("withdrawn", [])]  # those of before have none
        self.method.set_state(state["method"])  # type: ignore[attr-defined]  # it has told

    def why_nothing(self) -> str:
        """Why there is no option, in a sentence; where there are some, that there are."""
        seen, name = self.outcomes, type(self.method).__name__
        if self.found or self.n_withdrawn or seen.n == 0 or (seen.needed and not seen.successes):
            return super().why_nothing()
        if self.recurrence.nothing:
            return f"No subgoal was discovered: {self.recurrence.why(len(self.database), f'{self.outcomes.unit}s')}"
        for waits_for, n, what in (("min_trajectories", seen.n, ""), ("min_successes", seen.successes, "successful ")):
            if n < (least := getattr(self.method, waits_for, 0)):
                waits = f"{name} waits for {least} {what}{seen.unit}s ({waits_for}), and {n} have ended."
                return f"No subgoal was discovered: {waits}"
        return f"No subgoal was discovered: {name} proposed none that the filters leave.{self._left_out()}"


def discovery_with(
    settings: DiscoverySettings,
    groups: Iterable[FeatureGroup] = (),
    method: DiscoveryMethod | None = None,
    *,
    seed: int = 0,
    **how: Any,
) -> SubgoalDiscovery:
    """Discovery as the settings have it: on groups of features, by a method, or by diverse density on all features.

    Args:
        settings: Of discovery.
        groups: Of features; empty where all count.
        method: A user's own; by default the one that the settings name.
        seed: Of a method that draws at random and is made here.
        **how: Other arguments of `SubgoalDiscovery`.

    Raises:
        ValueError: A method other than diverse density and random places is to work on groups of features.
    """
    groups, name = tuple(groups), settings.method
    if settings.salient_share and not groups:
        logger.warning(
            "salient_share=%g has no effect: it is for groups of features, and there are none.", settings.salient_share
        )
    if groups and method is None and name == "random":
        return RandomGroupedDiscovery(settings, groups=groups, seed=seed, **how)
    if method is None and name in METHODS:
        method = method_named(name, seed)
    if groups and (method is not None or name != "diverse-density"):
        what = name if method is None else type(method).__name__
        raise ValueError(
            f"{what} works on all features together, and the feature map has groups: use diverse density, or "
            "the control 'random'; or, in a script, pass groups=() to SubgoalDiscoveryCallback."
        )
    if method is not None:
        return ProposedDiscovery(settings, method=method, **how)
    return GroupedDiscovery(settings, groups=groups, **how) if groups else SubgoalDiscovery(settings, **how)
