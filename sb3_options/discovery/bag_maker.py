"""From the trajectories of a database to the bags of one search."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.density.bags import Bags, first_rows
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.one_hot import is_one_hot
from sb3_options.density.regions import Region
from sb3_options.discovery.contrast import Contrast
from sb3_options.discovery.local_cuts import LocalCuts
from sb3_options.discovery.settings import DiscoverySettings, default_scale
from sb3_options.discovery.static_filter import (
    StaticFilter,
    kept_by,
    near_start_and_goal,
    steps_from,
    steps_from_start_and_goal,
)
from sb3_options.discovery.ways import PassingShare, loop_erased
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.experience.trajectories import LabelledTrajectory

AT_ONCE = 1 << 17
"""Features of ways whose distances to a subgoal are taken at once, about."""


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
    def n_instances(self) -> int:
        """In all bags."""
        return sum(map(len, self.positive)) + sum(map(len, self.negative))

    @cached_property
    def bags(self) -> Bags:
        """Packed, when first asked for."""
        return Bags.pack(self.positive, self.negative)


@dataclass(eq=False)
class _Known:
    """What was made of a trajectory.

    Attributes:
        labelled: The trajectory.
        rows: Rows of the states of ``way``, (k,).
        way: φ of the states that it led through, in order, or of all that it visited, (k, d). Each once: a state that
            is visited often would count often in the noisy-or (McGovern & Barto 2001, §3).
        scaled: The same in scaled units.
        allowed: Which of them the static filter leaves, (k,).
        kept: Which of them are in the bag.
        bag: Its bag.
        numbers: Of ``way`` in the `LocalCuts`, (k,); None as long as nobody asked.
    """

    labelled: LabelledTrajectory
    rows: IntArray
    way: FloatArray
    scaled: FloatArray
    allowed: BoolArray
    kept: BoolArray | None = None
    bag: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    numbers: IntArray | None = None


class BagMaker:
    """Makes the bags. A bag that does not change is the same array every time.

    Args:
        settings: How.
        static_filter: What may be a subgoal; by default not near start and goal.
        kind: Where φ comes from, for `default_scale`.
        group: The features that count, if not all do. Then the other states than places of the group are no instances.
        contrast: Of the group: what a state of a successful trajectory must stand out by to be an instance.

    Attributes:
        scale: Factor for every feature that counts, (d,); None before the first bags.
        cuts: Of all that was visited; None where ``DiscoverySettings.min_cut`` does not count.
    """

    def __init__(
        self,
        settings: DiscoverySettings,
        static_filter: StaticFilter | None,
        kind: str | None,
        group: FeatureGroup | None = None,
        contrast: Contrast | None = None,
    ) -> None:
        self.settings, self.kind, self.static_filter = settings, kind, static_filter
        self.group, self.contrast = group, contrast
        self.scale: FloatArray | None = None
        self._passing = PassingShare(settings.subgoal_radius)
        self._known: dict[int, _Known] = {}
        asked = settings.min_cut > 0.0 and settings.min_passing > 0.0 and group is None
        self.cuts = LocalCuts() if asked else None

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
        self._find_scale(database)
        assert self.scale is not None  # of any trajectories
        old = {id(known.labelled): known for known in self._known.values()}  # a copied object has another id
        needed = database if self.settings.negative_bags else positive
        self._known = {id(t): old.get(id(t)) or self._know(t, self.scale) for t in needed}
        known = [self._known[id(t)] for t in positive]
        self._remake(known, self._passages(known), taken)
        positive_bags = [k.bag for k in known if len(k.bag)]
        if len(positive_bags) < self.settings.min_positive:
            return None
        negative_bags = []
        if self.settings.negative_bags:
            known = [self._known[id(t)] for t in database if not t.success]
            if known:
                self._remake(known, np.concatenate([k.allowed for k in known]), taken)
            negative_bags = [k.bag for k in known if len(k.bag)]
        return FilteredBags(positive_bags, negative_bags)

    def _find_scale(self, database: Sequence[LabelledTrajectory]) -> None:
        """Set the scale, by all that was seen so far, unless it is set."""
        if self.scale is not None:
            return
        if self.group is not None:
            self.scale = np.asarray(self.group.scale) * (self.settings.scale or 1.0)
            return
        seen = np.concatenate([t.features for t in database])
        given = self.settings.scale
        if self.kind == "identity" and is_one_hot(seen):
            self.kind = "categorical"
        self.scale = default_scale(self.kind, seen) if given is None else np.full(seen.shape[1], given)

    def knows_scale(self, database: Iterable[LabelledTrajectory], n_seen: int) -> bool:
        """Whether the scale is known; where the range of features sets it, a search's number of trajectories is needed.

        Args:
            database: Those that are kept.
            n_seen: How many there have been.
        """
        database = list(database)
        if database and (self.kind != "identity" or n_seen >= self.settings.min_positive):
            self._find_scale(database)
        return self.scale is not None

    def may_be_subgoals(self, labelled: LabelledTrajectory, taken: Sequence[Region]) -> BoolArray:
        """Which states of a trajectory may be subgoals, (m,): the static filter leaves them, and no subgoal is near."""
        assert self.scale is not None  # `knows_scale` is asked first
        features, allowed = labelled.features, self._allowed(labelled, self.scale)
        if taken:
            known = _Known(labelled, np.arange(len(features)), features, features * self.scale, allowed)
            allowed = allowed & self._apart([known], taken)
        return allowed

    def is_known(self, instance: FloatArray) -> bool:
        """Whether it is known what an instance (d,) cuts off; it is `min_cut` at least, or it would be none."""
        return self.cuts is not None and bool(self.cuts.are_known(self.cuts.numbers(instance[None]))[0])

    def ways(self) -> list[FloatArray]:
        """The states of each way that may be subgoals, in scaled units, as of the last bags, (k_i, d) each."""
        return [known.scaled[known.allowed] for known in self._known.values() if known.labelled.success]

    def visited(self, trajectories: Iterable[LabelledTrajectory]) -> None:
        """Add what trajectories visited to the `cuts`."""
        if self.cuts is not None:
            for labelled in trajectories:
                self.cuts.add(labelled.features, labelled.trajectory.visits)

    def forget_space(self) -> None:
        """Features are others from now on."""
        self.cuts = None if self.cuts is None else LocalCuts()
        for known in self._known.values():
            known.numbers = None

    def forget_bags(self) -> None:
        """Every bag changes: instances near a new subgoal are filtered out."""
        for known in self._known.values():
            known.kept = None

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint.

        Shares of passing ways are not: they are counts, which are the same when all ways are counted anew.
        """
        known = [{f.name: getattr(k, f.name) for f in fields(k)} for k in self._known.values()]
        cuts = None if self.cuts is None else self.cuts.get_state()
        return {"scale": self.scale, "kind": self.kind, "known": known, "cuts": cuts}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self.scale, self.kind = state["scale"], state["kind"]
        self._known = {id(known["labelled"]): _Known(**known) for known in state["known"]}
        if self.cuts is not None:
            self.cuts.set_state(state["cuts"])

    def _know(self, labelled: LabelledTrajectory, scale: FloatArray) -> _Known:
        features, visits = self._own(labelled), labelled.trajectory.visits
        scaled = features * scale
        erase = labelled.success and self.settings.loops == "erase"
        # Different observations may have the same φ; a way without loops has none twice.
        rows = loop_erased(scaled, visits, self.settings.subgoal_radius) if erase else first_rows(scaled)
        allowed = self._allowed(labelled, scale)
        return _Known(labelled, rows, features[rows], scaled[rows], allowed[rows])

    def _own(self, labelled: LabelledTrajectory) -> FloatArray:
        """The features that count, (m, d)."""
        return labelled.features if self.group is None else self.group.own(labelled.features)

    def _allowed(self, labelled: LabelledTrajectory, scale: FloatArray) -> BoolArray:
        """Which states the static filter leaves, (m,)."""
        s, visits = self.settings, labelled.trajectory.visits
        if self.counts_steps:
            return steps_from_start_and_goal(visits, s.start_radius, s.goal_radius)
        static_filter = self.static_filter or near_start_and_goal(s.start_radius, s.goal_radius)
        allowed = kept_by(static_filter, self._own(labelled), int(visits[-1]), scale)
        return allowed if self.group is None else allowed & self.group.is_place(labelled.features)

    @property
    def counts_steps(self) -> bool:
        """Whether radii are steps along the trajectory, because states have no distances."""
        return self.kind == "categorical" and self.static_filter is None and self.group is None

    def _passages(self, known: Sequence[_Known]) -> BoolArray:
        """Which states stand out: `min_contrast`; or what the ways near them lead through: `min_passing`, `min_cut`.

        All ways at once, way after way: there are a hundred, and a call for each takes longer than what it computes.
        """
        allowed = np.concatenate([k.allowed for k in known])
        if self.contrast is not None:
            least = self.settings.min_contrast
            outstanding = [self.contrast.stands_out(k.labelled, least)[k.rows] for k in known]
            stand_out: BoolArray = allowed & np.concatenate(outstanding)
            return stand_out
        if self.settings.min_passing == 0.0:
            return allowed
        passages: BoolArray = allowed & (self._passing.update([k.scaled for k in known]) >= self.settings.min_passing)
        if self.cuts is not None:
            for k in known:
                k.numbers = self.cuts.numbers(k.way) if k.numbers is None else k.numbers
            numbers = np.concatenate([k.numbers for k in known if k.numbers is not None])
            passages[passages] = self.cuts.shares(numbers[passages]) >= self.settings.min_cut
        return passages

    def _remake(self, known: Sequence[_Known], keep: BoolArray, taken: Sequence[Region]) -> None:
        """Make the bags of these ways that change, of the states to ``keep`` way after way."""
        ends = np.cumsum([len(k.way) for k in known])
        changed = {i for i, k in enumerate(known) if k.kept is None}
        if len(changed) < len(known):  # a way that is new has a mask that says nothing yet
            kept = np.concatenate([k.allowed if k.kept is None else k.kept for k in known])
            changed.update(np.searchsorted(ends, np.flatnonzero(keep != kept), side="right").tolist())
        some = [(known[i], keep[ends[i] - len(known[i].way) : ends[i]].copy()) for i in sorted(changed)]
        at_once = max(AT_ONCE // max((k.way.size for k, _ in some), default=1), 1)
        for first in range(0, len(some), at_once):
            self._remake_these(some[first : first + at_once], taken)

    def _remake_these(self, known: Sequence[tuple[_Known, BoolArray]], taken: Sequence[Region]) -> None:
        """Make the bags of some ways, each with the states to keep."""
        apart = np.concatenate([kept for _, kept in known]) & self._apart([k for k, _ in known], taken)
        at = 0
        for k, kept in known:
            k.kept, k.bag = kept, k.way[apart[at : at + len(kept)]]
            at += len(kept)

    def _apart(self, known: Sequence[_Known], taken: Sequence[Region]) -> BoolArray:
        """Which states of some ways are farther than `spacing` from all subgoals, way after way, (Σ k_i,)."""
        apart: BoolArray = np.ones(sum(len(each.rows) for each in known), dtype=bool)
        if self.counts_steps:
            for subgoal in taken:
                apart &= np.concatenate([self._steps(each, subgoal) for each in known]) > self.settings.spacing
        elif places := [subgoal.points[0] for subgoal in taken if len(subgoal.points)]:
            assert self.scale is not None  # set before any bag is made
            distances = cdist(np.concatenate([each.scaled for each in known]), np.array(places) * self.scale)
            apart &= np.all(distances > self.settings.spacing, axis=1)
        return apart

    def _steps(self, known: _Known, subgoal: Region) -> IntArray:
        """How many steps along the trajectory the states of a way are from a subgoal, (k,)."""
        there = np.flatnonzero(subgoal.contains(known.labelled.features))
        return steps_from(there, known.labelled.trajectory.visits)[known.rows]
