"""Subgoal discovery: trajectories in, persistent peaks of diverse density out (McGovern & Barto 2001, Table 1)."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Literal, NamedTuple

import numpy as np

from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity, Peak
from sb3_options.density.incremental import IncrementalSearch
from sb3_options.discovery.outcomes import Outcomes
from sb3_options.discovery.peaks import PeakTracker, plateau_centres
from sb3_options.discovery.static_filter import StaticFilter, SuccessRule, bag_of, near_start_and_goal, reported_success
from sb3_options.experience.observations import FloatArray, batch_size
from sb3_options.experience.recording import RewardPeaks
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory, TrajectoryDatabase
from sb3_options.options.option import Region


@dataclass(frozen=True)
class DiscoverySettings:
    """How subgoals are found (McGovern & Barto 2001, §4–5). Distances are in scaled units of concept space.

    Attributes:
        segmentation: What a trajectory is: one of the ``episodes``, or, for continuing tasks, a segment between two
            ``peaks`` of reward (`continuing.RewardPeaks`).
        peak_reward: The least reward of a peak; None takes any that is positive.
        max_segment: Primitive steps without a peak that make an unsuccessful segment; more than random exploration
            takes from peak to peak.
        capacity: How many trajectories are kept: the last n.
        min_positive: Positive bags needed before the first search: over a few bags, accidents tie with bottlenecks.
        negative_bags: Whether unsuccessful trajectories become negative bags.
        negative_strength: η in (0, 1]: how strongly an instance of a negative bag speaks against a concept near it.
            Below 1 because an unsuccessful trajectory may well pass a bottleneck (the paper's §8).
        leak: λ in [0, 1): the probability that a trajectory succeeds without the bottleneck, because there is another
            way. Above 0, a trajectory of the other way costs a concept no more than log λ, and with λ = 0.2 what lies
            on some 60 % of the successful trajectories still reaches a ``min_density`` of 0.5. Not for ``incremental``.
        search: ``gradient`` ascent from many starts, ``exhaustive`` over the instances of positive bags, or
            ``incremental``: ascent from the peaks of the last search and the best instances of the newest positive
            bag, over bags that are packed once. With many or long trajectories it takes a small part of the time.
        scale: Factor for every feature, 1/width of the Gaussians; None takes `default_scale`.
        start_radius: The default static filter keeps subgoals this far from where a trajectory began.
        goal_radius: … and this far from where it ended.
        decay: λ of the running averages.
        threshold: Share of the limit λ/(1−λ) that makes a concept persistent.
        peak_radius: A peak belongs to the nearest known concept within this distance.
        peak_tolerance: Peaks whose log diverse density is within this of the best one count as found, in nats.
        min_density: Geometric mean over the positive bags of Pr(t | bag) that a peak must reach to count as found: a
            bottleneck lies on nearly every successful trajectory. 0 lets every peak count.
        max_places: If the best diverse density is shared by more separate places than this, they are accidents of few
            or long trajectories, and none counts as found.
        max_extent: A plateau of tied peaks that reaches farther than this from its middle is open space that all
            trajectories happened to cross, no bottleneck: a search whose best peaks include one finds nothing.
        subgoal_radius: The subgoal is everything within this distance of the persistent peak.
        spacing: A new subgoal must be farther than this from those that have an option.
    """

    segmentation: Literal["episodes", "peaks"] = "episodes"
    peak_reward: float | None = None
    max_segment: int = 10_000
    capacity: int = 100
    min_positive: int = 8
    negative_bags: bool = True
    negative_strength: float = 0.1
    leak: float = 0.0
    search: Literal["gradient", "exhaustive", "incremental"] = "gradient"
    scale: float | None = None
    start_radius: float = 2.0
    goal_radius: float = 5.0
    decay: float = 0.9
    threshold: float = 0.6
    peak_radius: float = 1.5
    peak_tolerance: float = 1e-3
    min_density: float = 0.5
    max_places: int = 2
    max_extent: float = math.inf
    subgoal_radius: float = 0.5
    spacing: float = 3.0

    def __post_init__(self) -> None:
        """Refuse values out of range, by name."""
        for name in ("capacity", "min_positive", "max_places"):
            if not isinstance(getattr(self, name), Integral) or getattr(self, name) < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {getattr(self, name)}.")
        for name in (
            "start_radius",
            "goal_radius",
            "peak_radius",
            "peak_tolerance",
            "max_extent",
            "subgoal_radius",
            "spacing",
        ):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}.")
        if self.scale is not None and not 0 < self.scale < math.inf:
            raise ValueError(f"scale must be positive and finite, got {self.scale}.")
        if not 0.0 < self.negative_strength <= 1.0:
            raise ValueError(f"negative_strength must be in (0, 1], got {self.negative_strength}.")
        if not 0.0 <= self.leak < 1.0:
            raise ValueError(f"leak must be in [0, 1), got {self.leak}.")
        if self.leak and self.search == "incremental":
            raise ValueError(f"search='incremental' knows no leak, got leak={self.leak}: use 'gradient'.")
        if not 0.0 <= self.min_density <= 1.0:
            raise ValueError(f"min_density must be in [0, 1], got {self.min_density}.")
        if self.search not in ("gradient", "exhaustive", "incremental"):
            raise ValueError(f"search must be 'gradient', 'exhaustive' or 'incremental', got {self.search!r}.")
        if self.segmentation not in ("episodes", "peaks"):
            raise ValueError(f"segmentation must be 'episodes' or 'peaks', got {self.segmentation!r}.")
        # These refuse what is out of their range.
        PeakTracker(decay=self.decay, threshold=self.threshold)
        RewardPeaks(self.peak_reward, self.max_segment)

    def reward_peaks(self) -> RewardPeaks | None:
        """Where experience is cut; None where episodes end it."""
        return RewardPeaks(self.peak_reward, self.max_segment) if self.segmentation == "peaks" else None


CATEGORICAL_SCALE = 6.0
"""One-hot codes of two states are then 6√2 = 8.5 units apart, farther than any default radius: equal or not."""

UNITS_PER_RANGE = 20.0
"""Features nobody scaled are taken to have this many distinguishable values along the range seen so far."""


def default_scale(kind: str | None, features: FloatArray) -> FloatArray:
    """The scale that makes one unit of concept space one step, as far as that can be known.

    Args:
        kind: Where φ comes from (`features.FeatureKind`). A user's φ and an environment's own are taken to be in
            such units already.
        features: All that was seen so far, shape (m, d).

    Returns:
        Factors, shape (d,): 1, or `CATEGORICAL_SCALE`, or `UNITS_PER_RANGE` over the range of each feature.
    """
    d = features.shape[1]
    if kind == "categorical":
        return np.full(d, CATEGORICAL_SCALE)
    if kind == "identity":
        extent = np.ptp(features, axis=0)
        return UNITS_PER_RANGE / np.where(extent > 0, extent, UNITS_PER_RANGE)
    return np.ones(d)


WARM_STARTS = 4
"""A search also starts from this many peaks of the one before."""


class Search(NamedTuple):
    """What one search found.

    Attributes:
        peaks: Best first; empty if there was nothing to search.
        bags: What was searched; None if there was nothing.
        seconds: Wall time.
    """

    peaks: list[Peak]
    bags: Bags | None
    seconds: float


class Finding(NamedTuple):
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
        self.found: list[Finding] = []
        unit = "episode" if s.segmentation == "episodes" else "segment"
        self.outcomes = Outcomes(unit, self.success is not reported_success)
        self.last = Search([], None, 0.0)
        self.seconds = 0.0
        self.scale: FloatArray | None = None
        self._incremental: IncrementalSearch | None = None
        self._cut: dict[int, tuple[LabelledTrajectory, FloatArray]] = {}
        self._filter = self.static_filter or near_start_and_goal(s.start_radius, s.goal_radius)

    def add(self, trajectory: Trajectory, features: FloatArray) -> LabelledTrajectory:
        """Put a trajectory into the database.

        Args:
            trajectory: One episode.
            features: φ of its distinct observations, shape (m, d).

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
        labelled = LabelledTrajectory(trajectory, features, bool(self.success(trajectory)))
        self.outcomes.add(trajectory, success=labelled.success)
        self.database.add(labelled)
        return labelled

    def search(self) -> Region | None:
        """Search the bags once and update the running averages.

        Returns:
            A new subgoal, if a concept has become persistent. It counts as taken from then on.
        """
        began = time.perf_counter()
        chosen = self._chosen()
        bags: Bags | None = None
        peaks: list[Peak] = []
        if chosen is not None:
            assert self.scale is not None  # set by _chosen()
            engine = self.engine()
            bags = Bags.pack(*chosen)
            if self._is_incremental:
                if self._incremental is None:
                    self._incremental = IncrementalSearch(self.scale, self.settings.negative_strength)
                peaks = self._incremental.search(*chosen)
            else:
                peaks = engine.search(bags, starts=self._warm_starts(engine))
            tied = [p.point for p in peaks if p.log_density >= peaks[0].log_density - self.settings.peak_tolerance]
            places, extent = plateau_centres(np.array(tied), self.scale, self.settings.peak_radius)
            dense = self._is_dense(peaks[0], bags, engine)
            few = len(places) <= self.settings.max_places and extent <= self.settings.max_extent
            self.tracker.update(places if dense and few else places[:0], self.scale)
        self.last = Search(peaks, bags, time.perf_counter() - began)
        self.seconds += self.last.seconds
        return self._new_subgoal()

    @property
    def _is_incremental(self) -> bool:
        return self.settings.search == "incremental" and self.kind != "categorical"

    def _is_dense(self, peak: Peak, bags: Bags, engine: DiverseDensity) -> bool:
        """Whether most positive bags hold the peak: `DiscoverySettings.min_density`."""
        if self._is_incremental and np.exp(peak.log_density / bags.n_positive) >= self.settings.min_density:
            return True  # even with the negative bags, which can only lower it
        log_density = float(engine.log_density(peak.point[None], bags.positive())[0])
        return bool(np.exp(log_density / bags.n_positive) >= self.settings.min_density)

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
        chosen = self._chosen()
        return None if chosen is None else Bags.pack(*chosen)

    def _chosen(self) -> tuple[list[FloatArray], list[FloatArray]] | None:
        """Positive and negative bags, oldest first; None while there are too few positive ones to search."""
        positive = [t for t in self.database if t.success]
        if len(positive) < self.settings.min_positive:
            return None
        if self.scale is None:
            seen = np.concatenate([t.features for t in self.database])
            given = self.settings.scale
            self.scale = default_scale(self.kind, seen) if given is None else np.full(seen.shape[1], given)
        self._cut = {id(t): self._cut[id(t)] for t in self.database if id(t) in self._cut}
        positive_bags = [bag for t in positive if len(bag := self._bag(t))]
        if len(positive_bags) < self.settings.min_positive:
            return None
        negative_bags = []
        if self.settings.negative_bags:
            negative_bags = [bag for t in self.database if not t.success and len(bag := self._bag(t))]
        return positive_bags, negative_bags

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
        assert self.scale is not None  # set by _chosen() before any bag is made
        bag = bag_of(labelled.features, int(labelled.trajectory.visits[-1]), self.scale, self._filter)
        for subgoal in [*self.taken, *(finding.subgoal for finding in self.found)]:
            centre = subgoal.points[0]
            bag = bag[np.linalg.norm((bag - centre) * self.scale, axis=1) > self.settings.spacing]
        return bag

    def _new_subgoal(self) -> Region | None:
        for concept in self.tracker.persistent():
            point = self._nearest_instance(concept.point)
            if point is None:
                continue
            assert self.scale is not None  # a concept is tracked only after a search
            assert self.last.bags is not None
            subgoal = Region(point[None], self.scale, self.settings.subgoal_radius)
            self.found.append(Finding(subgoal, self.last.bags, self.last.peaks[0].log_density))
            self.tracker = PeakTracker(
                decay=self.settings.decay, threshold=self.settings.threshold, radius=self.settings.peak_radius
            )
            self.last = Search([], self.last.bags, self.last.seconds)
            self._incremental, self._cut = None, {}  # without what is now too near a subgoal every bag is another
            return subgoal
        return None

    def _nearest_instance(self, point: FloatArray) -> FloatArray | None:
        """The instance of a positive bag nearest to ``point``: a peak may lie where nobody can stand."""
        instances = [bag for t in self.database if t.success and len(bag := self._bag(t))]
        if not instances or self.scale is None:
            return None
        candidates = np.concatenate(instances)
        return np.array(candidates[np.linalg.norm((candidates - point) * self.scale, axis=1).argmin()])
