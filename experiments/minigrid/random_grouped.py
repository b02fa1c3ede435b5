"""A control of discovery on groups of features: states that are drawn, not found."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.discovery.diary import Diary
from sb3_options.discovery.methods import Experience
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.methods.grouped import GroupedPeaks
from sb3_options.experience.observations import FloatArray


class RandomGrouped(GroupedPeaks):
    """A control: draws subgoals where `GroupedPeaks` searches for them, as soon as it may search.

    A group is drawn, then a state of that group: any that a positive bag may hold, far enough from other subgoals.

    Args:
        contrasting: Whether the state has to stand out by its `Contrast`, too, as it has to for diverse density.
        seed: Of the draws.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_random",)

    def __init__(self, *, contrasting: bool = False, seed: int = 0) -> None:
        super().__init__()
        self.contrasting = contrasting
        self._random = np.random.default_rng(seed)

    def proposals(self, experience: Experience) -> list[Region]:
        """One state that is drawn; none before `min_positive` trajectories have succeeded."""
        if self._n_successful < self.settings.min_positive:
            return []
        places = {group: self._drawable(member, experience) for group, member in self.members.items()}
        able = [group for group in self.members if len(places[group])]
        if not able:
            return []
        group = able[self._random.integers(len(able))]
        point = places[group][self._random.integers(len(places[group]))]
        scale = self.members[group].filters.known_scale
        return [Region(point[None], scale, self.settings.subgoal_radius, group=group)]

    def accept(self, goal: Region) -> float:
        """There is nothing to start again."""
        return float("nan")

    def why_nothing(self, diary: Diary) -> str:
        """Why it proposed nothing, where it might have."""
        if self._n_successful < self.settings.min_positive or self.contrasting:
            return super().why_nothing(diary)
        return f"the filters leave no state of {self._n_successful} successful trajectories."

    def _drawable(self, member: PersistentPeaks, experience: Experience) -> FloatArray:
        """The distinct states of a group that may be drawn, (n, k)."""
        filters, contrast = member.filters, member.contrast
        assert contrast is not None  # each member has one
        scale = filters.find_scale(experience.database)
        states = []
        for labelled in filter(lambda each: each.success, experience.database):
            allowed = filters.allowed(labelled)
            if self.contrasting:
                allowed &= contrast.stands_out(labelled)
            states.append(filters.own(labelled)[allowed])
        places: FloatArray = np.unique(np.concatenate(states), axis=0)
        for region in experience.avoided:
            if region.group == filters.group:
                away = np.linalg.norm((places - region.points[0]) * scale, axis=1)
                places = places[away > self.settings.spacing]
        return places
