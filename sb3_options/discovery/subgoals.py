"""Subgoal discovery: trajectories in, persistent peaks of diverse density out (McGovern & Barto 2001, Table 1)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity, Peak
from sb3_options.density.incremental import IncrementalSearch
from sb3_options.density.regions import Region
from sb3_options.discovery.outcomes import Outcomes
from sb3_options.discovery.peaks import PeakTracker, plateau_centres
from sb3_options.discovery.settings import DiscoverySettings, default_scale, is_one_hot
from sb3_options.discovery.static_filter import (
    StaticFilter,
    bag_of,
    first_visits,
    near_start_and_goal,
    steps_from,
    steps_from_start_and_goal,
)
from sb3_options.experience.observations import FloatArray, batch_size
from sb3_options.experience.success import SuccessRule, reported_success
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory, TrajectoryDatabase

WARM_STARTS = 4
"""A search also starts from this many peaks of the one before."""


@dataclass(frozen=True)
class FilteredBags:
    """The filtered bags of a database, oldest first.

    Attributes:
        positive: Instances (n_i, d) of each successful trajectory.
        negative: Instances of each unsuccessful one.
    """

    positive: list[FloatArray]
    negative: list[FloatArray]

    @cached_property
    def bags(self) -> Bags:
        """Packed, when first asked for: an incremental search does without."""
        return Bags.pack(self.positive, self.negative)


class Search(NamedTuple):
    """What one search found.

    Attributes:
        peaks: Best first; empty if there was nothing to search.
        evidence: What was searched; None if there was nothing.
        seconds: Wall time.
    """

    peaks: list[Peak]
    evidence: FilteredBags | None
    seconds: float

    @property
    def bags(self) -> Bags | None:
        """What was searched; None if there was nothing."""
        return None if self.evidence is None else self.evidence.bags


class FoundSubgoal(NamedTuple):
    """A subgoal, with the bags it was found in.

    Attributes:
        subgoal: In concept space.
        bags: Of the search that completed it.
        log_density: Best log diverse density of that search.
    """

    subgoal: Region
    bags: Bags
    log_density: float


@dataclass
class SubgoalDiscovery:
    """The state of discovery: what was lived through, which peaks persist, which subgoals were taken.

    Args:
        settings: How.
        success: Which trajectories make positive bags; by default what the environment reports.
        static_filter: What may be a subgoal; by default not near start and goal.
        kind: Where φ comes from, for `default_scale`.
        taken: Subgoals that have an option already, besides those `found`.
    """

    settings: DiscoverySettings = field(default_factory=DiscoverySettings)
    success: SuccessRule = reported_success
    static_filter: StaticFilter | None = None
    kind: str | None = None
    taken: Sequence[Region] = ()

    def __post_init__(self) -> None:
        """Set up what grows with experience."""
        s = self.settings
        self.database = TrajectoryDatabase(s.capacity)
        self.tracker = PeakTracker(decay=s.decay, threshold=s.threshold, radius=s.peak_radius)
        self.found: list[FoundSubgoal] = []
        unit = "episode" if s.segmentation == "episodes" else "segment"
        self.outcomes = Outcomes(unit, self.success is not reported_success)
        self.last = Search([], None, 0.0)
        self.seconds = 0.0
        self.scale: FloatArray | None = None
        self._incremental: IncrementalSearch | None = None
        self._cut: dict[int, tuple[LabelledTrajectory, FloatArray]] = {}
        self._filter = self.static_filter or near_start_and_goal(s.start_radius, s.goal_radius)

    def add(self, trajectory: Trajectory, features: FloatArray, *, success: bool | None = None) -> LabelledTrajectory:
        """Put a trajectory into the database.

        Args:
            trajectory: One episode.
            features: φ of its distinct observations, shape (m, d).
            success: Its label; by default what the rule of success says.

        Returns:
            The trajectory with its label.

        Raises:
            ValueError: ``features`` does not fit the trajectory, or is not finite.
        """
        features = np.asarray(features, dtype=np.float64)
        n_states = batch_size(trajectory.states)
        if features.ndim != 2 or len(features) != n_states:
            raise ValueError(
                f"features must have shape (m, d), one row for each of the trajectory's {n_states} distinct "
                f"observations, got {features.shape}"
            )
        if not np.isfinite(features).all():
            raise ValueError("the feature map gave NaN or infinite features for a trajectory")
        labelled = LabelledTrajectory(
            trajectory, features, bool(self.success(trajectory) if success is None else success)
        )
        self.outcomes.add(trajectory, success=labelled.success)
        self.database.add(labelled)
        return labelled

    def search(self) -> Region | None:
        """Search the bags once and update the running averages.

        Returns:
            A new subgoal, if a concept has become persistent. It counts as taken from then on.
        """
        began = time.perf_counter()
        evidence = self._evidence()
        peaks: list[Peak] = []
        if evidence is not None:
            assert self.scale is not None  # set by _evidence()
            engine = self.engine()
            peaks = self._peaks(evidence, engine)
            tied = [p.point for p in peaks if p.log_density >= peaks[0].log_density - self.settings.peak_tolerance]
            places, extent = plateau_centres(np.array(tied), self.scale, self.settings.peak_radius)
            few = len(places) <= self.settings.max_places and extent <= self.settings.max_extent
            found = few and self._is_dense(peaks[0], evidence, engine)
            self.tracker.update(places if found else places[:0], self.scale)
        self.last = Search(peaks, evidence, time.perf_counter() - began)
        self.seconds += self.last.seconds
        return self._new_subgoal()

    def _peaks(self, evidence: FilteredBags, engine: DiverseDensity) -> list[Peak]:
        if self.settings.search != "incremental" or engine.method == "exhaustive":
            return engine.search(evidence.bags, starts=self._warm_starts(engine))
        if self._incremental is None:
            self._incremental = IncrementalSearch(engine)
        return self._incremental.search(evidence.positive, evidence.negative)

    def _is_dense(self, peak: Peak, evidence: FilteredBags, engine: DiverseDensity) -> bool:
        """Whether most positive bags hold the peak: `DiscoverySettings.min_density`."""
        if np.exp(peak.log_density / len(evidence.positive)) >= self.settings.min_density:
            return True  # even with the negative bags, which can only lower it
        log_density = float(engine.log_density(peak.point[None], evidence.bags.positive())[0])
        return bool(np.exp(log_density / len(evidence.positive)) >= self.settings.min_density)

    def _warm_starts(self, engine: DiverseDensity) -> FloatArray | None:
        """The best peaks of the last search, for a search that can start from them."""
        if engine.method == "exhaustive" or not self.last.peaks:
            return None
        return np.array([peak.point for peak in self.last.peaks[:WARM_STARTS]])

    def why_nothing(self) -> str:
        """Why there is no option, in a sentence."""
        seen = self.outcomes
        why = "no peak of diverse density persisted long enough."
        if seen.n == 0:
            why = f"no {seen.unit} has ended."
        elif seen.successes == 0:
            why = seen.why_no_success()
        elif self.found:
            why = "one was found that no saved trajectory leads to, so that no option could be made."
        elif self.last.bags is None:
            why = (
                f"{seen.successes} of {seen.n} {seen.unit}s were successful; a search needs "
                f"{self.settings.min_positive} (min_positive) of which the static filter leaves something."
            )
        return f"No subgoal was discovered: {why}"

    def bags(self) -> Bags | None:
        """The bags of the database; None while there are too few positive ones to search."""
        evidence = self._evidence()
        return None if evidence is None else evidence.bags

    def _evidence(self) -> FilteredBags | None:
        """The bags of the database; None while there are too few positive ones to search."""
        positive = [t for t in self.database if t.success]
        if len(positive) < self.settings.min_positive:
            return None
        if self.scale is None:
            seen = np.concatenate([t.features for t in self.database])
            given = self.settings.scale
            if self.kind == "identity" and is_one_hot(seen):
                self.kind = "categorical"
            self.scale = default_scale(self.kind, seen) if given is None else np.full(seen.shape[1], given)
        self._cut = {id(t): self._cut[id(t)] for t in self.database if id(t) in self._cut}
        positive_bags = [bag for t in positive if len(bag := self._bag(t))]
        if len(positive_bags) < self.settings.min_positive:
            return None
        negative_bags = []
        if self.settings.negative_bags:
            negative_bags = [bag for t in self.database if not t.success and len(bag := self._bag(t))]
        return FilteredBags(positive_bags, negative_bags)

    def engine(self) -> DiverseDensity:
        """The diverse density these settings mean."""
        return DiverseDensity(
            scale=1.0 if self.scale is None else self.scale,
            negative_strength=self.settings.negative_strength,
            leak=self.settings.leak,
            method="exhaustive" if self.settings.search == "exhaustive" or self.kind == "categorical" else "gradient",
        )

    def _bag(self, labelled: LabelledTrajectory) -> FloatArray:
        """The filtered bag of a trajectory, the same array every time: cutting all anew took most of a search."""
        if id(labelled) not in self._cut:
            self._cut[id(labelled)] = labelled, self._filtered(labelled)
        return self._cut[id(labelled)][1]

    def _filtered(self, labelled: LabelledTrajectory) -> FloatArray:
        assert self.scale is not None  # set by _evidence() before any bag is made
        taken = [*self.taken, *(finding.subgoal for finding in self.found)]
        if self.kind == "categorical" and self.static_filter is None:
            return self._filtered_by_steps(labelled, taken)
        bag = bag_of(labelled.features, int(labelled.trajectory.visits[-1]), self.scale, self._filter)
        for subgoal in taken:
            centre = subgoal.points[0]
            bag = bag[np.linalg.norm((bag - centre) * self.scale, axis=1) > self.settings.spacing]
        return bag

    def _filtered_by_steps(self, labelled: LabelledTrajectory, taken: Sequence[Region]) -> FloatArray:
        """The same where states have no distances."""
        s, visits = self.settings, labelled.trajectory.visits
        keep = steps_from_start_and_goal(visits, s.start_radius, s.goal_radius)
        for subgoal in taken:
            keep &= steps_from(np.flatnonzero(subgoal.contains(labelled.features)), visits) > s.spacing
        return first_visits(labelled.features[keep])

    def _new_subgoal(self) -> Region | None:
        for concept in self.tracker.persistent():
            point = self._nearest_instance(concept.point)
            if point is None:
                continue
            assert self.scale is not None  # a concept is tracked only after a search
            assert self.last.bags is not None
            subgoal = Region(point[None], self.scale, self.settings.subgoal_radius)
            self.found.append(FoundSubgoal(subgoal, self.last.bags, self.last.peaks[0].log_density))
            self.tracker = PeakTracker(
                decay=self.settings.decay, threshold=self.settings.threshold, radius=self.settings.peak_radius
            )
            self.last = Search([], self.last.evidence, self.last.seconds)
            self._incremental, self._cut = None, {}  # every bag changes: instances near the subgoal are filtered out
            return subgoal
        return None

    def _nearest_instance(self, point: FloatArray) -> FloatArray | None:
        """The instance of a positive bag nearest to ``point``: a peak may lie where nobody can stand."""
        instances = [bag for t in self.database if t.success and len(bag := self._bag(t))]
        if not instances or self.scale is None:
            return None
        candidates = np.concatenate(instances)
        return np.array(candidates[np.linalg.norm((candidates - point) * self.scale, axis=1).argmin()])
