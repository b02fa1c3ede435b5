"""Makes the bags of one search from the trajectories of a database."""

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sb3_options.density.bags import Bags, first_rows
from sb3_options.density.regions import Region
from sb3_options.discovery.contrast import Contrast
from sb3_options.discovery.filters import Filters, Way
from sb3_options.discovery.local_cuts import MIN_CUT, LocalCuts
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.discovery.ways import PassingShare, loop_erased
from sb3_options.experience.observations import BoolArray, FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.state import storable


@storable
@dataclass(frozen=True, eq=False)
class FilteredBags:
    """The filtered bags of a database, oldest first."""

    positive: list[FloatArray]  # instances (n_i, d) of each successful trajectory
    negative: list[FloatArray]  # and of each unsuccessful one

    @cached_property
    def n_instances(self) -> int:
        """Number of instances in all bags."""
        return sum(map(len, self.positive)) + sum(map(len, self.negative))

    @property
    def n_features(self) -> int:
        """Number of features of an instance, d."""
        return int(self.positive[0].shape[1])

    @cached_property
    def bags(self) -> Bags:
        """The same bags, packed on first use."""
        return Bags.pack(self.positive, self.negative)


class BagMaker:
    """Makes bags. A checkpoint holds only the `cuts`; the rest follows from the database."""

    STATE = ("cuts",)

    def __init__(self, settings: DiscoverySettings, filters: Filters, contrast: Contrast | None = None) -> None:
        self.settings = settings
        self.filters = filters
        self.contrast = contrast
        self.emptied_by = ""  # setting of the filter that left too few bags, or of the last filter
        self._passing = PassingShare(settings.subgoal_radius)
        self._known: dict[LabelledTrajectory, Way] = {}
        self._others: list[Region] = []
        self.cuts = LocalCuts() if settings.min_passing > 0.0 and filters.group is None else None

    def make(self, database: Iterable[LabelledTrajectory], others: Sequence[Region]) -> FilteredBags | None:
        """Return the bags of a database, None if fewer than `min_positive` successes have an instance."""
        database = list(database)
        positive = [t for t in database if t.success]
        if len(positive) < self.settings.min_positive:
            return None
        self._know(database if self.settings.negative_strength > 0 else positive, others)
        known = [self._known[t] for t in positive]
        left = self._standing_out(known)
        left["spacing"] = left[list(left)[-1]] & np.concatenate([k.far for k in known])
        sizes = [len(k.rows) for k in known]
        whose = np.repeat(np.arange(len(known)), sizes)
        for self.emptied_by, keep in left.items():
            some = np.unique(whose[keep]).tolist()
            if len(some) < self.settings.min_positive:
                return None
        ends = np.cumsum(sizes).tolist()
        positive_bags = [known[i].states[keep[ends[i] - sizes[i] : ends[i]]] for i in some]
        negative = [k.states[k.allowed & k.far] for t, k in self._known.items() if not t.success]
        return FilteredBags(positive_bags, [bag for bag in negative if len(bag)])

    def cuts_off(self, instance: FloatArray) -> bool:
        """Whether an instance (d,) is known to cut off its surroundings: `make` dropped those below ``MIN_CUT``."""
        return self.cuts is not None and bool(self.cuts.are_known(instance[None])[0])

    def visited(self, labelled: LabelledTrajectory) -> None:
        """Add the states that a trajectory visited to the `cuts`."""
        if self.cuts is not None:
            self.cuts.add(labelled.features, labelled.trajectory.visits)

    def forget_space(self) -> None:
        """Start again in another feature space."""
        self.cuts = None if self.cuts is None else LocalCuts()
        self._known = {}

    def _know(self, trajectories: Sequence[LabelledTrajectory], others: Sequence[Region]) -> None:
        """Make the ways of new trajectories, forget those not given, and mark states far from other subgoals."""
        self._known = {t: self._known.get(t) or self._way(t) for t in trajectories}
        same = len(others) == len(self._others) and all(map(operator.is_, others, self._others))
        self._others = list(others)
        for k in self._known.values():
            if not (same and len(k.far)):
                k.far = self.filters.far_from(k, others)

    def _way(self, labelled: LabelledTrajectory) -> Way:
        states, visits = self.filters.own(labelled), labelled.trajectory.visits
        scaled = states * self.filters.known_scale
        erase = labelled.success and self.settings.loops == "erase"
        # Different observations may share one φ. A loop-erased way has no duplicates.
        rows = loop_erased(scaled, visits, self.settings.subgoal_radius) if erase else first_rows(scaled)
        return Way(labelled, rows, states[rows], scaled[rows], self.filters.allowed(labelled)[rows])

    def _standing_out(self, known: Sequence[Way]) -> dict[str, BoolArray]:
        """Return which states each filter leaves, in sequence: radii, then contrast, or `min_passing` and cuts.

        All ways are concatenated: a hundred small calls would cost more than the arithmetic.
        """
        allowed: BoolArray = np.concatenate([k.allowed for k in known])
        left = {"radii": allowed}
        if self.contrast is not None:
            outstanding = [self.contrast.stands_out(k.labelled)[k.rows] for k in known]
            return left | {"contrast": np.concatenate(outstanding) & allowed}
        if self.settings.min_passing == 0.0:
            return left
        passages: BoolArray = allowed & (self._passing.update([k.scaled for k in known]) >= self.settings.min_passing)
        left["min_passing"] = passages
        if self.cuts is not None:
            states = np.concatenate([k.states for k in known])
            left["cuts"] = passages.copy()
            left["cuts"][passages] = self.cuts.shares(states[passages]) >= MIN_CUT
        return left
