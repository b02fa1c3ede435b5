import copy
from typing import Any

import numpy as np
import pytest

from sb3_options.discovery.bags import BagMaker
from sb3_options.discovery.filters import Filters
from sb3_options.discovery.local_cuts import MIN_CUT
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import LabelledTrajectory
from tests.support.helpers import ball, line

PLAIN: dict[str, Any] = {
    "min_positive": 1, "start_radius": 0.0, "goal_radius": 0.0, "loops": "keep", "min_passing": 0.0, "scale": 1.0,
}  # fmt: skip


def maker(**changes: Any) -> BagMaker:
    settings = DiscoverySettings(**{**PLAIN, **changes})
    return BagMaker(settings, Filters(settings, scale=np.full(1, settings.scale)))


def made(maker: BagMaker, trajectories: Any, taken: Any = ()) -> list[list[float]] | None:
    """The places in the positive bags."""
    bags = maker.make(trajectories, taken)
    return None if bags is None else [bag.ravel().tolist() for bag in bags.positive]


def make(*trajectories: LabelledTrajectory, taken: Any = (), **changes: Any) -> list[list[float]] | None:
    return made(maker(**changes), trajectories, taken)


def test_each_state_once_in_order_of_first_visits() -> None:
    assert make(line([0, 5, 3, 5, 7, 3, 20])) == [[5, 3, 7]]


def test_different_observations_with_the_same_features_are_one_instance() -> None:
    trajectory = line([0, 1, 2, 3, 9])
    same = LabelledTrajectory(trajectory.trajectory, np.array([[0.0], [4.0], [6.0], [4.0], [9.0]]), True)
    assert make(same, loops="keep") == [[4, 6]]
    assert make(same, loops="erase") == [[4]]


def test_not_near_start_and_end_nor_near_what_is_taken() -> None:
    way, radii = line([0, 1, 5, 9, 12, 19, 20]), {"start_radius": 2.0, "goal_radius": 2.0}
    assert make(way, **radii, taken=[ball(10.0)], spacing=1.5) == [[5, 12]]


def test_spacing_has_the_unit_of_the_scale() -> None:
    # A step of 1 counts 2: within 3 of the subgoal lies what is nearer than 1.5.
    assert make(line([0, 5, 8, 9, 12, 20]), scale=2.0, taken=[ball(10.0)], spacing=3.0) == [[5, 8, 12]]


def test_too_few_positive_bags_are_none() -> None:
    assert make(line([0, 5, 20]), min_positive=2) is None
    assert make(line([0, 5, 20]), line([0, 20]), min_positive=2) is None, "nothing is left of one of them"


def test_a_new_subgoal_changes_the_bags_near_it() -> None:
    ways = [line([0, 10, 30 + i % 2, 60]) for i in range(6)]
    one = maker(min_passing=0.7)
    assert [made(one, ways, taken) for taken in ([], [ball(10.0)], [])] == [[[10.0]] * 6, None, [[10.0]] * 6]


def test_an_instance_cuts_off_enough_and_lies_on_enough_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    """The share of ways that pass a place counts one way more; a cut of exactly `MIN_CUT` is enough."""
    ways = [line([0, 10, 20, 30, 40 + i % 2, 60]) for i in range(4)]
    one = maker(min_passing=0.8)
    assert one.cuts is not None
    cut_off = {10.0: MIN_CUT, 20.0: np.nextafter(MIN_CUT, 0), 30.0: 0.5}
    monkeypatch.setattr(one.cuts, "shares", lambda states: np.array([cut_off[state] for state in states.ravel()]))
    assert made(one, ways) == [[10.0, 30.0]] * 4
    assert made(maker(min_passing=0.81), ways) is None
    assert list(one._standing_out([one._known[way] for way in ways])) == ["radii", "min_passing", "cuts"]


def test_a_copy_makes_the_same_bags() -> None:
    trajectories = [line([0, 5, i, 20]) for i in (7, 9, 11)]
    for changes in ({}, {"min_passing": 0.4, "loops": "erase"}):
        one = maker(**changes)
        before = made(one, trajectories)
        assert before is not None
        other, copies = copy.deepcopy((one, trajectories))
        assert made(one, trajectories) == made(other, copies) == made(other, trajectories) == before
