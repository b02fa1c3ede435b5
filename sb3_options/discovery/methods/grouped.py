"""Discovery on feature groups: each group has bags, peaks and subgoals in its own features."""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, cast

import numpy as np

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.budget import nominal_seconds
from sb3_options.discovery.contrast import MIN_CONTRAST, Contrast
from sb3_options.discovery.diary import Diary
from sb3_options.discovery.filters import Filters
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.methods.method import Experience, Method
from sb3_options.discovery.salience import OutcomeDatabase
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import TrajectoryDatabase


class GroupedPeaks(Method):
    """Runs `PersistentPeaks` once per feature group. A subgoal leaves the features of other groups open.

    A bag holds all places of its group that the trajectory visited, in the group's own features. `start_radius`,
    `goal_radius` and `spacing` are measured in these. ``loops`` and ``min_passing`` do not apply: to a moving agent, a
    repeated state need not be a loop, nor does a path lead through it. Instead an instance of a successful trajectory
    must stand out by its `Contrast`. A search follows a success, and later a few of them (``search_growth``).
    """

    STATE: ClassVar[tuple[str, ...]] = ("_members", "_leading", "_searched", "_n_successful", "_n_standing")

    needs_success = True
    searches = True
    again_after = 0.0

    def __init__(self) -> None:
        self._leading = 0
        self._searched = 0
        self._n_successful = 0
        self._n_standing = 0

    def begin(self, settings: DiscoverySettings, filters: Filters, groups: Sequence[FeatureGroup]) -> None:
        """Set up the search of each group; as `Method.begin`."""
        self.settings = settings
        self.learns_from_failures = settings.negative_strength > 0 or settings.salient_share > 0
        own = replace(settings, loops="keep", min_passing=0.0)
        contrasts: dict[FeatureGroup, Contrast] = {}
        for group in sorted(groups, key=lambda group: len(group.features)):
            parts = [c for part, c in contrasts.items() if set(part.features) < set(group.features)]
            radius = own.subgoal_radius / (own.scale or 1.0)
            contrasts[group] = Contrast(group, radius, parts)
        self._contrasts = list(contrasts.values())  # smaller groups first, as each group is compared with its parts
        self._groups = tuple(groups)
        self._members = [PersistentPeaks(contrasts[group]) for group in groups]
        for group, member in self.members.items():
            member.begin(own, Filters(own, filters.static_filter, filters.kind, group))

    @property
    def members(self) -> dict[FeatureGroup, PersistentPeaks]:
        """The search of each group."""
        return dict(zip(self._groups, self._members, strict=True))

    def is_due(self, database: TrajectoryDatabase) -> bool:
        """Whether enough trajectories have succeeded since the last search."""
        n_new = cast("OutcomeDatabase", database).n_entered - self._searched
        return n_new >= 1 and n_new >= self.settings.search_growth * database.n_successful

    def update(self, experience: Experience) -> list[Region]:
        """Search the bags of every group once, and propose the persistent concepts."""
        database = cast("OutcomeDatabase", experience.database)
        self._searched = database.n_entered
        self._n_successful = database.n_successful
        self._n_standing = sum(each.whole is not None for each in database)
        self._cost = 0.0
        if database.n_successful >= self.settings.min_positive:
            trajectories = list(database)
            for contrast in self._contrasts:
                contrast.update(trajectories)
                n, n_states = len(trajectories), contrast.n_states
                self._cost += nominal_seconds(contrast=1, compared=n, cell=n_states * (n + n_states))
            for member in self._members:
                assert member.contrast is not None  # each has one
                if member.contrast.largest() >= MIN_CONTRAST:
                    member.search(experience)
                    self._cost += member.seconds(experience)
                else:
                    member.maker.emptied_by = "contrast"
        self._leading = int(np.argmax([member.tracker.leading_average() for member in self._members]))
        return self.proposals(experience)

    def proposals(self, experience: Experience) -> list[Region]:
        """Return the proposals of the first group with any. Other groups come in later searches."""
        return next((found for each in self._members if (found := each.proposals(experience.database))), [])

    def accept(self, goal: Region) -> float:
        """Restart the running averages of the subgoal's group; as `Method.accept`."""
        assert goal.group is not None  # all subgoals here have one
        return self.members[goal.group].accept(goal)

    def values(self) -> dict[str, float]:
        """Return the values of the group whose concept has the largest average."""
        return self._members[self._leading].values()

    def n_successes(self, diary: Diary) -> int:
        """Count successes, including failures that stand for a success in the database."""
        return max(self._n_successful, diary.successes)

    def why_nothing(self, diary: Diary) -> str:
        """Say why it proposed nothing."""
        why = self._members[self._leading].why_nothing(diary, self._n_successful)
        n = self._n_standing
        return f"{why} Failures that stand for successes (salient_share): {n}." if n else why
