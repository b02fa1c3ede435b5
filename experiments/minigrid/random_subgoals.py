"""The controls of discovery: options to random subgoals, learned and looked after as those that it finds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.checks import groups_here
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.found import FoundSubgoal
from sb3_options.discovery.grouped import GroupedDiscovery
from sb3_options.experience.observations import FloatArray
from sb3_options.options.option import SubgoalOption


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
        subgoal = Region(point[None], np.asarray(group.scale), self.settings.subgoal_radius, group=group)
        self.found.append(FoundSubgoal(subgoal, None, math.nan))
        self.members[group].found.append(self.found[-1])
        return subgoal

    def _states(self, group: FeatureGroup) -> FloatArray:
        """The distinct states of a group that may be drawn, (n, k)."""
        member, kept = self.members[group], []
        for labelled in filter(lambda each: each.success, self.database):
            allowed = member._maker._allowed(labelled, np.asarray(group.scale))
            if self.contrasting:
                allowed &= self._contrasts[group].stands_out(labelled, self.settings.min_contrast)
            kept.append(group.own(labelled.features)[allowed])
        places: FloatArray = np.unique(np.concatenate(kept), axis=0)
        for known in [*member.taken, *(found.subgoal for found in member.found)]:
            away = np.linalg.norm((places - known.points[0]) * np.asarray(group.scale), axis=1)
            places = places[away > self.settings.spacing]
        return places


class RandomSubgoalsCallback(SubgoalDiscoveryCallback):
    """`SubgoalDiscoveryCallback` with `RandomGroupedDiscovery`; ``contrasting`` is its argument."""

    def __init__(self, *args: Any, contrasting: bool, **how: Any) -> None:
        super().__init__(*args, **how)
        self.contrasting = contrasting

    def _on_training_start(self) -> None:
        if self.discovery is None:
            slots = self.training_env.get_attr("bank", [0])[0].slots
            self.discovery = RandomGroupedDiscovery(
                self.settings,
                groups=groups_here(self.groups, self.training_env),
                success=self.success,
                kind=self.training_env.env_method("feature_kind", indices=[0])[0],
                taken=[option.subgoal for option in slots if isinstance(option, SubgoalOption)],
                contrasting=self.contrasting,
                seed=self.seed,
            )
        super()._on_training_start()
