"""A control on groups of features: random subgoals, which become options as those that discovery finds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.found import FoundSubgoal
from sb3_options.discovery.grouped import GroupedDiscovery
from sb3_options.experience.observations import FloatArray


@dataclass
class RandomGroupedDiscovery(GroupedDiscovery):
    """Draws subgoals where `GroupedDiscovery` searches for them, as soon as it may search.

    A group is drawn, then a state of that group: any that a positive bag may hold, far enough from other subgoals.

    Args:
        contrasting: Whether the state has to stand out by its `Contrast`, too, as it has to for diverse density.
        seed: Of the draws.
    """

    contrasting: bool = field(default=False, kw_only=True)
    seed: int = field(default=0, kw_only=True)

    def __post_init__(self) -> None:
        """Set up the generator."""
        super().__post_init__()
        self._random = np.random.default_rng(self.seed)

    def _new_subgoal(self) -> Region | None:
        if self.database.n_successful < self.settings.min_positive:
            return None
        places = {group: self._states(group) for group in self.groups}
        able = [group for group in self.groups if len(places[group])]
        if not able:
            return None
        group = able[self._random.integers(len(able))]
        point = places[group][self._random.integers(len(places[group]))]
        subgoal = Region(point[None], self._scale(group), self.settings.subgoal_radius, group=group)
        self.found.append(FoundSubgoal(subgoal, None, math.nan))
        self.members[group].found.append(self.found[-1])
        return subgoal

    def _states(self, group: FeatureGroup) -> FloatArray:
        """The distinct states of a group that may be drawn, (n, k)."""
        member, scale, kept = self.members[group], self._scale(group), []
        for labelled in filter(lambda each: each.success, self.database):
            allowed = member._maker._allowed(labelled, scale)
            if self.contrasting:
                allowed &= self._contrasts[group].stands_out(labelled, self.settings.min_contrast)
            kept.append(group.own(labelled.features)[allowed])
        places: FloatArray = np.unique(np.concatenate(kept), axis=0)
        for known in [*member.taken, *(found.subgoal for found in member.found)]:
            away = np.linalg.norm((places - known.points[0]) * scale, axis=1)
            places = places[away > self.settings.spacing]
        return places

    def _scale(self, group: FeatureGroup) -> FloatArray:
        """Factor for each feature of a group, (k,), as its bags have it."""
        member = self.members[group]
        member._maker.knows_scale(self.database, self.outcomes.n)
        assert member.scale is not None  # a group has its own, whatever was seen
        return member.scale

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {**super().get_state(), "random": self._random.bit_generator.state}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        super().set_state(state)
        self._random.bit_generator.state = state["random"]

    def why_nothing(self) -> str:
        """Why there is no option, in a sentence; where there are some, that there are."""
        n = self.settings.min_positive
        if self.found or self._n_positive < n or self.contrasting:
            return super().why_nothing()
        return f"No subgoal was discovered: the filters leave no state of {self._n_positive} successful trajectories."
