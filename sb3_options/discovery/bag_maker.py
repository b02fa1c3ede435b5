"""From the trajectories of a database to the bags of one search."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sb3_options.density.bags import Bags
from sb3_options.density.regions import Region
from sb3_options.discovery.settings import DiscoverySettings, default_scale
from sb3_options.discovery.static_filter import StaticFilter, bag_of, near_start_and_goal
from sb3_options.discovery.ways import PassingShare, loop_erased
from sb3_options.experience.observations import FloatArray, IntArray
from sb3_options.experience.trajectories import LabelledTrajectory


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


@dataclass
class _Known:
    """What was made of a trajectory.

    Attributes:
        labelled: The trajectory.
        rows: Its states that may become instances, before any filter.
        way: φ of these in scaled units.
        kept: Those of ``rows`` that the bag was made of.
        bag: Its bag.
    """

    labelled: LabelledTrajectory
    rows: IntArray
    way: FloatArray
    kept: IntArray | None = None
    bag: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))


class BagMaker:
    """Makes the bags. A bag that does not change is the same array every time, which incremental search relies on.

    Args:
        settings: How.
        static_filter: What may be a subgoal; by default not near start and goal.
        kind: Where φ comes from, for `default_scale`.

    Attributes:
        scale: Factor for every feature, (d,); None before the first bags.
    """

    def __init__(self, settings: DiscoverySettings, static_filter: StaticFilter | None, kind: str | None) -> None:
        self.settings, self.kind = settings, kind
        self.scale: FloatArray | None = None
        self._filter = static_filter or near_start_and_goal(settings.start_radius, settings.goal_radius)
        self._passing = PassingShare(settings.subgoal_radius)
        self._known: dict[int, _Known] = {}

    def make(self, database: Iterable[LabelledTrajectory], taken: Sequence[Region]) -> FilteredBags | None:
        """The bags of a database; None while there are too few positive ones to search.

        Args:
            database: Trajectories, oldest first.
            taken: Subgoals that have an option: no instance lies near them.
        """
        database = list(database)
        positive = [t for t in database if t.success]
        if len(positive) < self.settings.min_positive:
            return None
        if self.scale is None:
            seen = np.concatenate([t.features for t in database])
            given = self.settings.scale
            self.scale = default_scale(self.kind, seen) if given is None else np.full(seen.shape[1], given)
        self._known = {id(t): self._known.get(id(t)) or self._know(t, self.scale) for t in database}
        made = [self._bag(self._known[id(t)], rows, taken) for t, rows in self._passages(positive)]
        positive_bags = [bag for bag in made if len(bag)]
        if len(positive_bags) < self.settings.min_positive:
            return None
        negative_bags = []
        if self.settings.negative_bags:
            known = [self._known[id(t)] for t in database if not t.success]
            negative_bags = [bag for k in known if len(bag := self._bag(k, k.rows, taken))]
        return FilteredBags(positive_bags, negative_bags)

    def forget_bags(self) -> None:
        """Every bag changes: instances near a new subgoal are filtered out."""
        for known in self._known.values():
            known.kept = None

    def _know(self, labelled: LabelledTrajectory, scale: FloatArray) -> _Known:
        scaled = labelled.features * scale
        if labelled.success and self.settings.loops == "erase":
            rows = loop_erased(scaled, labelled.trajectory.visits, self.settings.subgoal_radius)
        else:
            rows = np.arange(len(scaled))
        return _Known(labelled, rows, scaled[rows])

    def _passages(self, positive: Sequence[LabelledTrajectory]) -> Iterable[tuple[LabelledTrajectory, IntArray]]:
        """Of each trajectory the states that the ways near them lead through: `DiscoverySettings.min_passing`."""
        known = [self._known[id(t)] for t in positive]
        if self.settings.min_passing == 0.0:
            return [(k.labelled, k.rows) for k in known]
        shares = self._passing.update([k.way for k in known])
        return [(k.labelled, k.rows[s >= self.settings.min_passing]) for k, s in zip(known, shares, strict=True)]

    def _bag(self, known: _Known, rows: IntArray, taken: Sequence[Region]) -> FloatArray:
        assert self.scale is not None  # set before any bag is made
        if known.kept is None or not np.array_equal(known.kept, rows):
            features, last = known.labelled.features, int(known.labelled.trajectory.visits[-1])
            bag = bag_of(features, rows, last, self.scale, self._filter)
            for subgoal in taken:
                distance = np.linalg.norm((bag - subgoal.points[0]) * self.scale, axis=1)
                bag = bag[distance > self.settings.spacing]
            known.kept, known.bag = rows, bag
        return known.bag
