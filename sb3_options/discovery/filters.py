"""Which states may be subgoals: those that pass the static filter and are far from all other subgoals."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.one_hot import is_one_hot
from sb3_options.density.regions import Region
from sb3_options.discovery.settings import DiscoverySettings, default_scale
from sb3_options.discovery.static_filter import StaticFilter, near_start_and_goal, steps_from, steps_from_start_and_goal
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.state import TRANSIENT


@dataclass(eq=False)
class Way:
    """States of a trajectory in order: its loop-erased path, or all visited states.

    Each state occurs once: repeated states would count repeatedly in the noisy-or (McGovern & Barto 2001, §3).
    """

    labelled: LabelledTrajectory
    rows: IntArray  # of its features, (k,)
    states: FloatArray  # features of these rows, or a group's own features, (k, d)
    scaled: FloatArray  # the same in scaled units
    allowed: BoolArray  # which states pass the static filter, (k,)
    far: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))  # from other subgoals; empty until computed


@dataclass
class Filters:
    """The static filter and the spacing, in a concept space and its scale."""

    settings: DiscoverySettings = field(metadata=TRANSIENT)
    static_filter: StaticFilter | None = field(default=None, metadata=TRANSIENT)
    kind: str | None = None
    group: FeatureGroup | None = field(default=None, metadata=TRANSIENT)
    scale: FloatArray | None = None

    def find_scale(self, database: Iterable[LabelledTrajectory]) -> FloatArray:
        """Return the scale. The first call sets it, from all trajectories of the database."""
        given = self.settings.scale
        if self.scale is None and self.group is not None:
            self.scale = np.asarray(self.group.scale) * (given or 1.0)
        elif self.scale is None:
            seen = np.concatenate([labelled.features for labelled in database])
            if self.kind == "identity" and is_one_hot(seen):
                self.kind = "categorical"
            self.scale = default_scale(self.kind, seen) if given is None else np.full(seen.shape[1], given)
        return self.scale

    @property
    def known_scale(self) -> FloatArray:
        """The scale, once it is found."""
        assert self.scale is not None  # `find_scale` is called before any search
        return self.scale

    @property
    def counts_steps(self) -> bool:
        """Whether radii are steps along the trajectory, because states have no distances."""
        return self.kind == "categorical" and self.static_filter is None and self.group is None

    def own(self, labelled: LabelledTrajectory) -> FloatArray:
        """Return the features of a trajectory that count, (m, d)."""
        return labelled.features if self.group is None else self.group.own(labelled.features)

    def allowed(self, labelled: LabelledTrajectory) -> BoolArray:
        """Which states of a trajectory pass the static filter, (m,)."""
        s = self.settings
        visits = labelled.trajectory.visits
        if self.counts_steps:
            return steps_from_start_and_goal(visits, s.start_radius, s.goal_radius)
        static_filter = self.static_filter or near_start_and_goal(s.start_radius, s.goal_radius)
        scaled = self.own(labelled) * self.known_scale
        allowed = np.asarray(static_filter(scaled, scaled[0], scaled[visits[-1]]), dtype=bool)
        if allowed.shape != (len(scaled),):
            raise ValueError(
                f"static_filter must return shape ({len(scaled)},), one bool a state, got {allowed.shape}."
            )
        return allowed if self.group is None else allowed & self.group.is_place(labelled.features)

    def may_be_subgoals(self, labelled: LabelledTrajectory, others: Sequence[Region]) -> BoolArray:
        """Which states pass the static filter and are far from other subgoals, (m,)."""
        way = self._whole(labelled)
        return way.allowed & self.far_from(way, others)

    def _whole(self, labelled: LabelledTrajectory) -> Way:
        """Return all states of a trajectory as a way."""
        states = self.own(labelled)
        return Way(labelled, np.arange(len(states)), states, states * self.known_scale, self.allowed(labelled))

    def far_from(self, way: Way, others: Sequence[Region]) -> BoolArray:
        """Which states of a way are farther than `spacing` from other subgoals, (k,)."""
        far: BoolArray = np.ones(len(way.rows), dtype=bool)
        spacing = self.settings.spacing
        if self.counts_steps:
            features, visits = way.labelled.features, way.labelled.trajectory.visits
            for subgoal in others:
                far &= steps_from(np.flatnonzero(subgoal.contains(features)), visits)[way.rows] > spacing
        elif places := [subgoal.points[0] for subgoal in others if len(subgoal.points)]:
            far &= (cdist(way.scaled, np.array(places) * self.known_scale) > spacing).all(axis=1)
        return far

    def is_apart(self, goal: Region, others: Sequence[Region], database: Iterable[LabelledTrajectory]) -> bool:
        """Whether a subgoal is farther than `spacing` from all others; always for one without a place.

        If states have no distances, steps are counted along the last trajectory that reached the subgoal.
        """
        spacing = self.settings.spacing
        if not self.counts_steps:
            away = [np.linalg.norm((goal.points[:1] - other.points[:1]) * self.known_scale, axis=1) for other in others]
            return all((distances > spacing).all() for distances in away)
        if len(goal.points) and any(np.array_equal(goal.points[:1], other.points[:1]) for other in others):
            return False
        for labelled in reversed(list(database)):
            there = goal.contains(labelled.features)
            if there.any():
                return bool(self.far_from(self._whole(labelled), others)[there].all())
        return True
