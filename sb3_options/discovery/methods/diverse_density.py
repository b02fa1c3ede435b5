"""Peaks of diverse density that persist (McGovern & Barto 2001, Table 1)."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from sb3_options.density.diverse_density import SHORTLIST_PAIRS, SMALLEST_BAGS, DiverseDensity, Peak
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.bags import BagMaker, FilteredBags
from sb3_options.discovery.budget import POINT_FEATURES, nominal_seconds
from sb3_options.discovery.contrast import Contrast
from sb3_options.discovery.diary import Diary
from sb3_options.discovery.filters import Filters
from sb3_options.discovery.methods.method import Experience, Method
from sb3_options.discovery.peaks import MOST_TIED, PEAK_RADIUS, PeakTracker, plateau_centres
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory, TrajectoryDatabase

WARM_STARTS = 4  # peaks of the last search that the next search also starts from
NOTHING_LEFT = 5  # once the filters leave nothing besides the subgoals found, one search in this many is made
ASCENTS = 96  # evaluations of all instances in a gradient search: 8 points ascend for 12 steps
EXHAUSTIVE_SHARE = 0.25  # cost of an evaluation without a gradient, as a share of one with a gradient
PEAK_TOLERANCE = 1e-3  # nats; peaks this close to the best log density tie with it: ascents are no more exact

REMEDIES = {
    "radii": "is far from start and goal. Lower start_radius, goal_radius (--discovery.start-radius, .goal-radius).",
    "contrast": "they visit much more often than failures do. Name other groups of features.",
    "min_passing": "enough of the others pass too. Lower min_passing (--discovery.min-passing), or make φ coarser.",
    "cuts": "cuts off enough of the other states. The task may have no bottleneck.",
    "spacing": "is far enough from the subgoals of options. Lower spacing (--discovery.spacing).",
}
"""What each filter demands of a state, and the remedy if it leaves too few."""


class PersistentPeaks(Method):
    """Searches the bags of the database, and proposes the peaks of diverse density that persist.

    A state of a successful trajectory must stand out by the ``contrast`` of its feature group, if there is one.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "filters",
        "tracker",
        "peaks",
        "evidence",
        "completed",
        "maker",
        "_n_new",
        "_n_since",
        "_n_accepted",
    )

    needs_success = True
    searches = True
    again_after = np.inf
    cut_threshold = 0.4  # instead of `threshold`, for a state known to cut off its surroundings: hardly an accident

    def __init__(self, contrast: Contrast | None = None) -> None:
        self.contrast = contrast
        self.peaks: list[Peak] = []  # of the last search, best first; empty after a subgoal is accepted
        self.evidence: FilteredBags | None = None  # of the last search
        self.completed: FilteredBags | None = None  # of the search that completed the last subgoal
        self._n_new = 0  # states whose bags are not made yet
        self._n_since = 0  # trajectories since the last search
        self._n_accepted = 0

    def begin(self, settings: DiscoverySettings, filters: Filters, groups: Sequence[FeatureGroup] = ()) -> None:
        """Set up the tracker and the bag maker; as `Method.begin`."""
        super().begin(settings, filters, groups)
        self.settings = settings
        self.filters = filters
        self.learns_from_failures = settings.negative_strength > 0
        self.tracker = PeakTracker(decay=settings.decay, radius=PEAK_RADIUS)
        self.maker = BagMaker(settings, filters, self.contrast)

    def note(self, labelled: LabelledTrajectory) -> None:
        """Note a trajectory when it ends, before any search."""
        self.maker.visited(labelled)
        self._n_new += len(labelled.features)
        self._n_since += 1

    def is_due(self, database: TrajectoryDatabase) -> bool:
        """Whether there are enough new trajectories for a search."""
        growth = self.settings.search_growth
        if self._n_accepted and self.evidence is None:
            growth = 1.0 - (1.0 - growth) ** NOTHING_LEFT
        return self._n_since >= growth * database.n_successful

    def update(self, experience: Experience) -> list[Region]:
        """Search the bags once, and propose the persistent concepts, most persistent first."""
        self.search(experience)
        return self.proposals(experience.database)

    def search(self, experience: Experience) -> None:
        """Search the bags once and update the running averages."""
        self._n_since = 0
        self.peaks, before = [], self.peaks
        self.evidence = evidence = self.bags(experience)
        if evidence is None:
            return
        engine = self.engine()
        exhaustive = engine.method == "exhaustive"
        starts = np.array([peak.point for peak in before[:WARM_STARTS]]) if before and not exhaustive else None
        self.peaks = [] if evidence.negative else self._certain(evidence, engine, starts)
        if self.peaks:
            self._cost += nominal_seconds(direct=1, certain=evidence.n_instances * evidence.n_features)
        else:
            self.peaks = self._search(evidence, engine, starts)
            self._cost += self._seconds_of_search(evidence, engine)
        self.tracker.update(self.places(), self.filters.known_scale)

    def _certain(self, evidence: FilteredBags, engine: DiverseDensity, starts: FloatArray | None) -> list[Peak]:
        """Return the peaks that need no search: points in all bags, none of which is negative."""
        return engine.certain(evidence.positive, starts)

    def _search(self, evidence: FilteredBags, engine: DiverseDensity, starts: FloatArray | None) -> list[Peak]:
        """Search the bags and return the peaks, best first."""
        return engine.search(evidence.bags, starts=starts)

    def _seconds_of_search(self, evidence: FilteredBags, engine: DiverseDensity) -> float:
        n, d = evidence.n_instances, evidence.n_features
        if self.filters.kind == "categorical":
            return nominal_seconds(direct=1, one_hot=n * d)
        sizes = sorted(map(len, evidence.positive))
        if engine.method == "exhaustive":
            n_points = sum(sizes) * EXHAUSTIVE_SHARE
        else:
            n_points = ASCENTS + min(sum(sizes[:SMALLEST_BAGS]), max(2 * ASCENTS, SHORTLIST_PAIRS // n))
        return nominal_seconds(search=1, pair=n * n_points * (d + POINT_FEATURES))

    def bags(self, experience: Experience) -> FilteredBags | None:
        """Return the bags of the database, None while too few are positive."""
        database = experience.database
        cuts = self.maker.cuts
        n_computed = 0 if cuts is None else cuts.n_computed
        if database.n_successful >= self.settings.min_positive:
            self.filters.find_scale(database)
        avoided = [region for region in experience.avoided if region.group == self.filters.group]
        evidence = self.maker.make(database, avoided)
        n, d = (0, 0) if evidence is None else (evidence.n_instances, evidence.n_features)
        self._cost = nominal_seconds(
            trajectory=len(database),
            state=self._n_new,
            state_feature=self._n_new * d,
            way_pair=self._n_new * n * (d + POINT_FEATURES),
            cut=0 if cuts is None else cuts.n_computed - n_computed,
        )
        self._n_new = 0
        return evidence

    def proposals(self, database: TrajectoryDatabase) -> list[Region]:
        """Return the persistent concepts of the last search, each as a region around its nearest instance."""
        if self.evidence is None:
            return []  # a subgoal of another group may have taken the bags of a persistent concept
        s = self.settings
        scale = self.filters.known_scale
        instances = np.concatenate(self.evidence.positive)
        proposals = []
        for concept in self.tracker.persistent(min(s.threshold, self.cut_threshold)):
            # A peak may lie where nobody can stand.
            point = instances[np.linalg.norm((instances - concept.point) * scale, axis=1).argmin()]
            if concept.average > s.threshold * self.tracker.limit or self.maker.cuts_off(point):
                proposals.append(Region(point[None], scale, s.subgoal_radius, group=self.filters.group))
        return proposals

    def accept(self, goal: Region) -> float:
        """Restart the running averages; as `Method.accept`."""
        best = self.peaks[0].log_density
        self._n_accepted += 1
        self.completed = self.evidence
        self.tracker.concepts.clear()
        self.peaks = []
        return best

    def engine(self) -> DiverseDensity:
        """Return diverse density with these settings."""
        exhaustive = self.settings.search == "exhaustive" or self.filters.kind == "categorical"
        return DiverseDensity(
            scale=1.0 if self.filters.scale is None else self.filters.scale,
            negative_strength=self.settings.negative_strength or 1.0,  # with 0 there are no negative bags
            leak=self.settings.leak,
            method="exhaustive" if exhaustive else "gradient",
        )

    def remembered(self) -> FloatArray:
        """Return where the concepts were last found, (n, d)."""
        return np.array([concept.point for concept in self.tracker.concepts])

    def embed_again(self, points: FloatArray, database: TrajectoryDatabase) -> None:
        """Move the running averages and forget the last search; as `Method.embed_again`."""
        for concept, point in zip(self.tracker.concepts, points, strict=True):
            concept.point = point
        self.peaks = []
        self.evidence = None
        self.completed = None
        self.maker.forget_space()
        for labelled in database:
            self.maker.visited(labelled)
        self._n_new = sum(len(labelled.features) for labelled in database)  # all bags are made anew

    def log_density(self, points: FloatArray) -> FloatArray | None:
        """Use the bags that completed the last subgoal, or else of the last search; as `Method.log_density`."""
        evidence = self.completed or self.evidence
        return None if evidence is None else np.asarray(self.engine().log_density(points, evidence.bags))

    def values(self) -> dict[str, float]:
        """Return the values to log, by tag."""
        values = {"search/leading_average": self.tracker.leading_average()}
        return values | ({"search/best_log_density": self.peaks[0].log_density} if self.peaks else {})

    def why_nothing(self, diary: Diary, n_positive: int | None = None) -> str:
        """Say why it proposed nothing from ``n_positive`` bags; as `Method.why_nothing`."""
        least = self.settings.min_positive
        if self.evidence is not None:
            return f"no peak of diverse density persisted (threshold) in {diary.n} {diary.unit}s. Train for longer."
        if (diary.successes if n_positive is None else n_positive) < least or not self.maker.emptied_by:
            return f"{diary.successes} of {diary.n} {diary.unit}s succeeded; a search needs {least}. Train for longer."
        return (
            f"{diary.successes} of {diary.n} {diary.unit}s succeeded, but fewer than {least} of them pass a state that "
            f"{REMEDIES[self.maker.emptied_by]}"
        )

    def places(self) -> FloatArray:
        """Return the centres of the best peaks' plateaus, (n, d)."""
        least = self.peaks[0].log_density - PEAK_TOLERANCE
        tied = np.array([peak.point for peak in self.peaks if peak.log_density >= least])
        return tied[:0] if len(tied) > MOST_TIED else plateau_centres(tied, self.filters.known_scale, PEAK_RADIUS)
