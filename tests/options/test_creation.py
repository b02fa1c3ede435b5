from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray, flatten
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options import creation
from sb3_options.options.creation import OptionGrowth, joined, learn_option
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from sb3_options.options.settings import OptionLearningSettings
from tests.options.corridor import DOOR, LEFT, RIGHT, generator, walk
from tests.support.helpers import ball, line


def learned(
    trajectories: Iterable[LabelledTrajectory], *, to: Region = DOOR, name: str = "subgoal", **settings: Any
) -> SubgoalOption:
    option = learn_option(to, trajectories, 2, OptionLearningSettings(**settings), generator(), name=name)
    assert option is not None
    return option


class TestLearnOption:
    trajectories = tuple(walk([1, 2, 3, 4, 5, 6]) for _ in range(3)) + tuple(walk([4, 3, 2, 1]) for _ in range(3))

    def test_option(self) -> None:
        option = learned(self.trajectories, name="door", initiation_steps=3, max_duration=12)
        assert (option.name, option.max_duration) == ("door", 12)
        bound = option.bind(flatten)
        places = np.arange(8.0)[:, None]
        assert np.flatnonzero(bound.initiation(places)).tolist() == [2, 3, 4]
        assert np.flatnonzero(bound.termination(places)).tolist() == [5]
        assert bound.policy(places[2:5]).tolist() == [RIGHT] * 3

    @pytest.mark.parametrize("walks", [[], [walk([1, 2, 3, 4]), walk([9, 8, 7])], [walk([5, 6, 7])]])
    def test_none_where_no_trajectory_leads_to_the_subgoal(self, walks: list[LabelledTrajectory]) -> None:
        assert learn_option(DOOR, walks, 2, OptionLearningSettings(), generator()) is None

    def test_on_a_group_of_features_nothing_else_counts(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The place is feature 1; feature 2 says where there is a place at all, the others are noise."""
        noise = np.random.default_rng(0)
        group = FeatureGroup("place", [1, 2], present=[[2]], scale=[1, 10])
        door = Region(np.array([[5.0, 1.0]]), np.array([1.0, 10.0]), 0.5, group=group)

        def seen(places: FloatArray, there: FloatArray) -> FloatArray:
            rest = noise.random((2, len(places)))
            return np.stack([rest[0], places * there, there, rest[1]], axis=1)

        known = []
        for trajectory in self.trajectories:
            places = trajectory.features[:, 0]
            known.append(replace(trajectory, features=seen(places, (places != 2).astype(float))))
        monkeypatch.setattr(creation, "MIN_REACH", 0.0)
        option = learned(known, to=door, initiation_steps=4)
        assert option.policy_input == "features"
        np.testing.assert_array_equal(option.initiation_set.points, [[1, 1], [3, 1], [4, 1]])  # nobody knows of 2
        bound = option.bind(flatten)
        places = np.arange(8.0)
        assert np.flatnonzero(bound.initiation(seen(places, np.ones(8)))).tolist() == [1, 3, 4]
        assert not bound.initiation(seen(places, np.zeros(8))).any()
        assert bound.policy(seen(places, np.ones(8)))[3:5].tolist() == [RIGHT] * 2
        monkeypatch.setattr(creation, "MIN_REACH", 0.4)
        surer = learned(known, to=door, initiation_steps=4)
        np.testing.assert_array_equal(surer.initiation_set.points, [[3, 1], [4, 1]])  # from 1 nobody came
        monkeypatch.setattr(creation, "MIN_REACH", 1.0)
        assert learn_option(door, known, 2, OptionLearningSettings(initiation_steps=4), generator()) is None

    def test_an_option_sees_more_than_its_subgoal_says(self) -> None:
        """Feature 0 is the place, 1 says whether the way to the left is free; if it is not, there is one around."""
        group = FeatureGroup("place", [0], seen=FeatureGroup("place, free", [0, 1], scale=[1, 10]))
        start = Region(np.array([[0.0]]), np.array([1.0]), 0.0, group=group)
        free = self.labelled([[2, 1], [1, 1], [0, 1]], [LEFT, LEFT])
        around = self.labelled([[2, 1], [1, 0], [7, 0], [0, 0]], [LEFT, RIGHT, LEFT])
        option = learned([free, around] * 5, to=start, initiation_steps=3, max_duration=50)
        assert option.max_duration == 3  # n
        assert option.subgoal.group == group
        assert option.initiation_set.group == group.sees
        np.testing.assert_array_equal(option.initiation_set.scale, [1, 10])
        bound = option.bind(flatten)
        walls = np.array([[1.0, 1.0], [1.0, 0.0], [7.0, 0.0], [7.0, 1.0]])
        assert bound.initiation(walls).tolist() == [True, True, True, False]
        assert bound.policy(walls[:3]).tolist() == [LEFT, RIGHT, LEFT]
        assert bound.termination(np.array([[0.0, 0.0], [0.0, 1.0]])).tolist() == [1, 1]
        blind = replace(start, group=FeatureGroup("place", [0]))
        option = learned([free, around] * 5, to=blind, initiation_steps=3, max_duration=50)
        actions = option.bind(flatten).policy(walls[:2])
        assert actions[0] == actions[1]  # what it cannot see it cannot go around

    def labelled(self, features: list[list[float]], actions: list[int]) -> LabelledTrajectory:
        """A trajectory through distinct states with these features."""
        trajectory = replace(
            self.trajectories[0].trajectory,
            states=np.arange(len(features), dtype=np.float64)[:, None] + 10 * len(features),
            visits=np.arange(len(features)),
            actions=np.array(actions),
        )
        return replace(self.trajectories[0], trajectory=trajectory, features=np.array(features, dtype=np.float64))

    @pytest.mark.parametrize("kind", ["table", "network"])
    def test_a_policy_of_features_needs_no_more_of_the_observation(
        self, kind: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(creation, "NETWORK_UPDATES", 500)
        noise = np.random.default_rng(0)
        noisy = []
        for known in self.trajectories:
            places = known.features
            states = np.concatenate([places, noise.random((len(places), 3))], axis=1)
            noisy.append(replace(known, trajectory=replace(known.trajectory, states=states)))
        option = learned(noisy, policy_input="features", value_function=kind)
        bound = option.bind(lambda observations: np.asarray(observations)[:, :1])
        unseen = np.concatenate([np.arange(2.0, 5.0)[:, None], noise.random((3, 3))], axis=1)
        assert bound.policy(unseen).tolist() == [RIGHT] * 3

    @pytest.mark.parametrize(
        ("kind", "n_walks", "expected"),
        [
            ("auto", 1, NetworkPolicy),
            ("auto", 2, TabularPolicy),  # 4 distinct observations in 8 steps
            ("table", 1, TabularPolicy),
            ("network", 5, NetworkPolicy),
        ],
    )
    def test_kind_of_value_function(
        self, kind: str, n_walks: int, expected: type, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(creation, "NETWORK_UPDATES", 1)
        option = learned([walk([1, 2, 3, 4, 5])] * n_walks, value_function=kind)
        assert type(option.option_policy) is expected


REACHES, MISSES = line([0, 1, 2]), line([0, 1, 0])


def test_due_at_every_doubling_of_what_reached_the_subgoal() -> None:
    growth, subgoal = OptionGrowth(), ball(2.0)
    growth.made(0, subgoal, [REACHES, MISSES, REACHES])
    due = [growth.is_due(0, subgoal, t) for t in (REACHES, MISSES, REACHES, REACHES, REACHES, REACHES, REACHES)]
    assert due == [False, False, True, False, False, False, True]


def test_an_adopted_option_is_learned_anew_once_enough_reach_it_here() -> None:
    growth = OptionGrowth()
    growth.adopted(0)
    assert [growth.is_due(0, ball(2.0), REACHES) for _ in range(20)] == [n in (10, 20) for n in range(1, 21)]


def test_joined_options_start_where_either_does_and_act_as_the_later_one_where_it_knows() -> None:
    first, later = (learned([walk(places)] * 4, initiation_steps=3) for places in ([2, 3, 4, 5], [8, 7, 6, 5]))
    assert isinstance(later.option_policy, TabularPolicy)
    # Here the way from 4 leads left.
    later = replace(later, option_policy=TabularPolicy(*(np.concatenate(pair) for pair in (
        (later.option_policy.states, [[4.0]]), (later.option_policy.values, [[-1.0, -np.inf]])
    ))))  # fmt: skip
    both = joined(first, later).bind(flatten)
    places = np.arange(10.0)[:, None]
    assert np.flatnonzero(both.initiation(places)).tolist() == [2, 3, 4, 6, 7, 8]
    assert both.policy(places[[2, 3, 4, 6, 7, 8]]).tolist() == [RIGHT, RIGHT, LEFT, LEFT, LEFT, LEFT]
    assert np.flatnonzero(first.bind(flatten).initiation(places)).tolist() == [2, 3, 4]  # unchanged
    network = replace(first, option_policy=NetworkPolicy(np.zeros(1), np.ones(1), [np.eye(1, 2)], [np.zeros(2)]))
    assert joined(network, later) is network


def test_a_closed_option_does_not_grow() -> None:
    growth, subgoal = OptionGrowth(), ball(2.0)
    growth.made(0, subgoal, [line([1, 2])])
    for _ in range(2):  # who is not known is forgotten already
        growth.forget(0)
    assert not any(growth.is_due(0, subgoal, line([1, 2])) for _ in range(9))
