"""Subgoal discovery: trajectories in, persistent peaks of diverse density out (McGovern & Barto 2001, Table 1)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity, Peak
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.anchors import moved, nearest_instance, nearest_observations
from sb3_options.discovery.bag_maker import BagMaker, FilteredBags
from sb3_options.discovery.budget import (
    CUT_SECONDS,
    EXHAUSTIVE_SHARE,
    Budget,
    n_compared,
    seconds_of_bags,
    seconds_of_certain,
    seconds_of_counting,
    seconds_of_search,
)
from sb3_options.discovery.found import FoundSubgoal, Search
from sb3_options.discovery.outcomes import Outcomes
from sb3_options.discovery.peaks import MOST_TIED, PeakTracker, plateau_centres
from sb3_options.discovery.recurrence import Recurrence
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.discovery.static_filter import StaticFilter
from sb3_options.discovery.ways import loop_erased
from sb3_options.experience.observations import FeatureMap, FloatArray, batch_size
from sb3_options.experience.success import SuccessRule, reported_success
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory, TrajectoryDatabase

WARM_STARTS = 4
"""A search also starts from this many peaks of the one before."""

NOTHING_LEFT = 5
"""Once subgoals were found, and the filters leave nothing else, one of so many searches is made."""


@dataclass
class SubgoalDiscovery:
    """The state of discovery: what was lived through, which peaks persist, which subgoals were taken.

    Args:
        settings: How.
        success: Which trajectories make positive bags; by default what the environment reports.
        static_filter: What may be a subgoal; by default not near start and goal.
        kind: Where φ comes from, for `default_scale`.
        taken: Subgoals that have an option already, besides those `found`.
        group: The features that count, if not all do.
    """

    settings: DiscoverySettings = field(default_factory=DiscoverySettings)
    success: SuccessRule = reported_success
    static_filter: StaticFilter | None = None
    kind: str | None = None
    taken: Sequence[Region] = ()
    group: FeatureGroup | None = None

    LEADS: ClassVar[str] = "leads"  # what a saved trajectory must do for an option, in words

    def __post_init__(self) -> None:
        """Set up what grows with experience."""
        s = self.settings
        self.taken = [region for region in self.taken if region.group == self.group]
        self.database = TrajectoryDatabase(s.capacity, s.max_bytes)
        self.tracker = PeakTracker(decay=s.decay, threshold=s.threshold, radius=s.peak_radius)
        self.found: list[FoundSubgoal] = []
        self.n_withdrawn = 0
        unit = "episode" if s.segmentation == "episodes" else "segment"
        self.outcomes = Outcomes(unit, self.success is not reported_success)
        self.last = Search([], None, 0.0)
        self.seconds = 0.0
        self.cost = 0.0
        self.budget = Budget(s.max_share)
        self.recurrence = Recurrence(s.min_positive, max(s.peak_radius, s.subgoal_radius))
        self._n_new = self._n_since = 0
        self._maker = BagMaker(s, self.static_filter, self.kind)

    @property
    def scale(self) -> FloatArray | None:
        """Factor for every feature, (d,); None before the first search."""
        return self._maker.scale

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
        features = np.require(features, np.float64, "O")  # a view would keep alive what it is a view of
        n_states = batch_size(trajectory.states)
        if features.ndim != 2 or len(features) != n_states:
            raise ValueError(
                f"features must have shape (m, d), one row for each of the trajectory's {n_states} distinct "
                f"observations, got {features.shape}"
            )
        if not np.isfinite(features).all():
            raise ValueError("a trajectory has features, or observations, that are NaN or infinite")
        labelled = LabelledTrajectory(
            trajectory, features, bool(self.success(trajectory) if success is None else success)
        )
        self.outcomes.add(trajectory, success=labelled.success)
        self.database.add(labelled)
        self._maker.visited([labelled])
        self.budget.steps += len(trajectory)
        self._n_new += n_states
        self._n_since += 1
        return labelled

    def search(self) -> Region | None:
        """Search the bags once and update the running averages, if enough is new and the `Budget` affords it.

        Returns:
            A new subgoal, if a concept has become persistent. It counts as taken from then on.
        """
        if not (self._is_due() and self.budget.affords()):
            return None
        self._n_since = 0
        self.update()
        self.budget.spent += self.cost
        return self._new_subgoal()

    def _is_due(self) -> bool:
        """Whether there are enough new trajectories for a search."""
        growth = self.settings.search_growth
        if self.found and self.last.evidence is None:
            growth = 1.0 - (1.0 - growth) ** NOTHING_LEFT
        return self._n_since >= growth * self.database.n_successful

    def withdraw(self) -> None:
        """Say that there is no option for the last subgoal; it counts as taken all the same."""
        self.n_withdrawn += 1

    def update(self) -> None:
        """Search the bags once and update the running averages; `search` without its end.

        `cost` says in nominal seconds what it took.
        """
        began = time.perf_counter()
        evidence = self._recurring_evidence()
        peaks: list[Peak] = []
        if evidence is not None:
            engine = self.engine()
            certain = [] if evidence.negative else self._certain(evidence, engine)
            peaks = certain or self._peaks(evidence, engine)
            assert self.scale is not None  # set with the first bags
            self.tracker.update(self._places(peaks), self.scale)
            self.cost += self._seconds_of_search(evidence, engine, certain=bool(certain))
        self.last = Search(peaks, evidence, time.perf_counter() - began)
        self.seconds += self.last.seconds

    def _recurring_evidence(self) -> FilteredBags | None:
        """The bags of the database; None where there are too few, or where nothing recurs."""
        self.cost, successes = 0.0, self.outcomes.successes
        due, cuts = self.recurrence.is_due(successes), self._maker.cuts
        n_computed = 0 if cuts is None else cuts.n_computed
        if self.recurrence.nothing and not due:
            return None
        evidence = self._evidence()
        n, d = (0, 0) if evidence is None else (evidence.n_instances, evidence.positive[0].shape[1])
        self.cost += seconds_of_bags(len(self.database), self._n_new, n, d)
        self.cost += 0.0 if cuts is None else CUT_SECONDS * (cuts.n_computed - n_computed)
        self._n_new = 0
        if due:
            self.cost += self.recurrence.look(self._maker.ways(), successes, f"successful {self.outcomes.unit}s")
        return None if self.recurrence.nothing else evidence

    def _seconds_of_search(self, evidence: FilteredBags, engine: DiverseDensity, *, certain: bool) -> float:
        n, sizes, d = evidence.n_instances, [len(bag) for bag in evidence.positive], evidence.positive[0].shape[1]
        if certain:
            return seconds_of_certain(n, d)
        if self.kind == "categorical":
            return seconds_of_counting(n, d)
        if engine.method == "exhaustive":
            return seconds_of_search(n, sum(sizes) * EXHAUSTIVE_SHARE, d)
        return seconds_of_search(n, n_compared(sizes, n), d)

    def _certain(self, evidence: FilteredBags, engine: DiverseDensity) -> list[Peak]:
        """The peaks where no search is needed: no bag is negative, and a point is in all of them."""
        return engine.certain(evidence.positive, self._warm_starts(engine))

    def _peaks(self, evidence: FilteredBags, engine: DiverseDensity) -> list[Peak]:
        return engine.search(evidence.bags, starts=self._warm_starts(engine))

    def _places(self, peaks: list[Peak]) -> FloatArray:
        """The middles of the best peaks' plateaus, (n, d); none if they are too many or too wide."""
        assert self.scale is not None
        tied = [p.point for p in peaks if p.log_density >= peaks[0].log_density - self.settings.peak_tolerance]
        if len(tied) > MOST_TIED:
            return np.array(tied[:0]).reshape(0, len(self.scale))
        places, extent = plateau_centres(np.array(tied), self.scale, self.settings.peak_radius)
        most = self.settings.max_places
        few = (most is None or len(places) <= most) and extent <= self.settings.max_extent
        return places if few else places[:0]

    def _warm_starts(self, engine: DiverseDensity) -> FloatArray | None:
        """The best peaks of the last search, for a search that can start from them."""
        if engine.method == "exhaustive" or not self.last.peaks:
            return None
        return np.array([peak.point for peak in self.last.peaks[:WARM_STARTS]])

    @property
    def learns_from_failures(self) -> bool:
        """Whether a search may find something after a failure."""
        return self.settings.negative_bags or self.settings.salient_share > 0

    @property
    def n_kept(self) -> int:
        """Subgoals found that there is an option for."""
        return len(self.found) - self.n_withdrawn

    def why_nothing(self) -> str:
        """Why there is no option, in a sentence; where there are some, that there are."""
        if self.n_kept > 0:
            return f"Subgoals discovered that have an option: {self.n_kept}."
        seen = self.outcomes
        why = "no peak of diverse density persisted long enough."
        if seen.n == 0:
            why = seen.why_none_ended()
        elif self._n_positive == 0:
            why = seen.why_no_success()
        elif self.found or self.n_withdrawn:
            why = f"no saved trajectory {self.LEADS} to the one that was found: there is no option."
        elif self.recurrence.nothing:
            why = self.recurrence.why(seen.successes, f"successful {seen.unit}s")
        elif self.last.bags is None:
            why = (
                f"{seen.successes} of {seen.n} {seen.unit}s were successful; a search needs "
                f"{self.settings.min_positive} (min_positive) of which the filters leave something."
            )
            if self._n_positive >= self.settings.min_positive:
                why += (
                    " They leave out what is near start and goal (start_radius, goal_radius), near the subgoal of an "
                    "option (spacing), and what few ways lead through (min_passing, min_cut)."
                )
        return f"No subgoal was discovered: {why}{self._stood_for_successes()}{self._left_out()}"

    @property
    def _n_positive(self) -> int:
        """Trajectories that make positive bags."""
        return self.outcomes.successes

    def _stood_for_successes(self) -> str:
        """What to add where failures make positive bags, too."""
        return ""

    def _left_out(self) -> str:
        """What to add where searches were left out."""
        if not self.budget.skipped or self.found or self.recurrence.nothing:
            return ""
        return (
            f" {self.budget.skipped} searches were left out, because max_share={self.settings.max_share:g} affords no "
            "more: a larger one, or features that are fewer, gives more of them."
        )

    def bags(self) -> Bags | None:
        """The bags of the database; None while there are too few positive ones to search."""
        evidence = self._evidence()
        return None if evidence is None else evidence.bags

    def _evidence(self) -> FilteredBags | None:
        found = [finding.subgoal for finding in self.found]
        bags = self._maker.make(self.database, [*self.taken, *found])
        self.kind = self._maker.kind  # what was seen may show that states have no distances
        return bags

    def passing_share(self, subgoal: Region) -> float:
        """The share of the successes in the database whose way, without loops, leads through a region.

        An option that no success needs to pass may be taken out of its slot. 0 without a success.
        """
        passed = []
        for labelled in filter(lambda each: each.success, self.database):
            features = labelled.features
            if subgoal.group is None:  # seen from an agent that moves, the same state twice need not be a loop
                scaled, visits = features * subgoal.scale, labelled.trajectory.visits
                features = features[loop_erased(scaled, visits, self.settings.subgoal_radius)]
            passed.append(bool(subgoal.contains(features).any()))
        return float(np.mean(passed)) if passed else 0.0

    def engine(self) -> DiverseDensity:
        """The diverse density these settings mean."""
        return DiverseDensity(
            scale=1.0 if self.scale is None else self.scale,
            negative_strength=self.settings.negative_strength,
            leak=self.settings.leak,
            method="exhaustive" if self.settings.search == "exhaustive" or self.kind == "categorical" else "gradient",
        )

    def embed_again(self, feature_map: FeatureMap) -> None:
        """Go on in the space of another feature map, with everything where its observation is.

        Subgoals stay at the observations where they were found, running averages at those nearest to their peaks. What
        was searched before is forgotten, for its distances are others.

        Args:
            feature_map: φ of the observations of all trajectories in the database. It must make as many features.
        """
        if self.tracker.concepts:
            points = np.stack([concept.point for concept in self.tracker.concepts])
            places = feature_map(nearest_observations(points, self.database))
            for concept, place in zip(self.tracker.concepts, places, strict=True):
                concept.point = place
        self.database.embed_again(feature_map)
        self.found = [
            found
            if found.observation is None
            else found._replace(subgoal=moved(found.subgoal, found.observation, feature_map), bags=None)
            for found in self.found
        ]
        self.last = Search([], None, self.last.seconds)
        self._maker.forget_space()
        self._maker.visited(self.database)
        self.recurrence.forget()
        self._n_new = sum(len(labelled.features) for labelled in self.database)  # bags are made anew of all

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        last = self.last
        bags = None if last.evidence is None else (last.evidence.positive, last.evidence.negative)
        return {
            "database": self.database.get_state(),
            "tracker": self.tracker.get_state(),
            "found": [tuple(each) for each in self.found],
            "outcomes": self.outcomes.get_state(),
            "last": {"peaks": last.peaks, "bags": bags, "seconds": last.seconds},
            "seconds": self.seconds,
            "kind": self.kind,
            "taken": list(self.taken),
            "maker": self._maker.get_state(),
            "budget": self.budget.get_state(),
            "recurrence": self.recurrence.get_state(),
            **{"n_new": self._n_new, "n_since": self._n_since, "n_withdrawn": self.n_withdrawn},
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self.database.set_state(state["database"])
        self.tracker.set_state(state["tracker"])
        self.found = [FoundSubgoal(*each) for each in state["found"]]
        self.outcomes.set_state(state["outcomes"])
        last = state["last"]
        evidence = None if last["bags"] is None else FilteredBags(*last["bags"])
        self.last = Search(last["peaks"], evidence, last["seconds"])
        self.seconds, self.kind, self.taken = state["seconds"], state["kind"], state["taken"]
        self._maker.set_state(state["maker"])
        self.budget.set_state(state["budget"])
        self.recurrence.set_state(state["recurrence"])
        self._n_new, self._n_since, self.n_withdrawn = state["n_new"], state["n_since"], state["n_withdrawn"]

    def _new_subgoal(self) -> Region | None:
        if self.last.evidence is None:
            return None  # what persists in one group may have lost its bags to a subgoal of another
        s, instances = self.settings, np.concatenate(self.last.evidence.positive)
        for concept in self.tracker.persistent(min(s.threshold, s.cut_threshold)):
            assert self.scale is not None  # a concept is tracked only after a search
            point = nearest_instance(instances, concept.point, self.scale)
            if concept.average <= s.threshold * self.tracker.limit and not self._maker.is_known(point):
                continue
            subgoal = Region(point[None], self.scale, self.settings.subgoal_radius, group=self.group)
            # Where φ is learned there are no groups, whose points have features of their own.
            there = None if self.group is not None else nearest_observations(point[None], self.database)
            density = self.last.peaks[0].log_density
            self.found.append(FoundSubgoal(subgoal, self.last.evidence.bags, density, observation=there))
            self.tracker = PeakTracker(
                decay=self.settings.decay, threshold=self.settings.threshold, radius=self.settings.peak_radius
            )
            self.last = Search([], self.last.evidence, self.last.seconds)
            self._maker.forget_bags()
            return subgoal
        return None
