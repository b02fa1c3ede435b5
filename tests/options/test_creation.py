import dataclasses
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import pytest
import torch

from sb3_options.density.regions import Region
from sb3_options.experience.observations import flatten
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.creation import (
    OptionLearningSettings,
    Transitions,
    initiation_set,
    learn_further,
    learn_option,
    option_transitions,
    replay_into_network,
    replay_into_table,
)
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from tests.support.helpers import ball, labelled, line, trajectory_of

DOOR = ball(5.0)
LEFT, RIGHT = 0, 1


def walk(places: Sequence[float], **kwargs: Any) -> LabelledTrajectory:
    """Along a line, where the actions are what the places say; a step that stays was to the left."""
    actions = [RIGHT if b > a else LEFT for a, b in pairwise(places)]
    return line(places, actions, **kwargs)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def centres(region: Region) -> list[float]:
    return sorted(region.points.ravel().tolist())


class TestInitiationSet:
    trajectories = (walk([1, 2, 3, 4, 5, 6, 7, 6, 5, 4]), walk([9, 8, 7]), walk([0, 1, 0, 4, 5]))

    @pytest.mark.parametrize(
        ("n", "visits", "expected"),
        [
            (1, "first", [4]),
            (2, "first", [0, 3, 4]),
            (3, "first", [0, 1, 2, 3, 4]),
            (1, "every", [4, 6]),
            (2, "every", [0, 3, 4, 6, 7]),
            # Four states before the second visit at time 8 lie 5 (the door itself, never in I), 6, 7 and 6.
            (4, "every", [0, 1, 2, 3, 4, 6, 7]),
            (100, "first", [0, 1, 2, 3, 4]),
        ],
    )
    def test_by_hand(self, n: int, visits: Literal["first", "every"], expected: list[float]) -> None:
        settings = OptionLearningSettings(initiation_steps=n, initiation_visits=visits)
        region = initiation_set(DOOR, self.trajectories, settings)
        assert centres(region) == expected
        assert region.radius == 0.5

    def test_subgoal_of_some_width(self) -> None:
        region = initiation_set(
            ball(5.0, radius=1.0), self.trajectories[:1], OptionLearningSettings(initiation_steps=2)
        )
        assert centres(region) == [2, 3]

    def test_a_visit_at_the_very_start_has_nothing_before_it(self) -> None:
        settings = OptionLearningSettings()
        assert centres(initiation_set(DOOR, [walk([5, 6, 5])], settings)) == []
        every = dataclasses.replace(settings, initiation_visits="every")
        assert centres(initiation_set(DOOR, [walk([5, 6, 5])], every)) == [6]

    def test_a_visit_sooner_than_n_steps_from_the_start(self) -> None:
        settings = OptionLearningSettings(initiation_steps=3)
        assert centres(initiation_set(DOOR, [walk([4, 5, 6, 7, 8, 9])], settings)) == [4]

    def test_no_visit_and_no_trajectories(self) -> None:
        for trajectories in ([], [walk([1, 2, 3])]):
            region = initiation_set(DOOR, trajectories, OptionLearningSettings())
            assert region.points.shape == (0, 1)
            assert not region.contains(np.array([[5.0]])).any()

    @pytest.mark.parametrize("visits", ["first", "every"])
    def test_the_subgoal_is_never_in_it(self, visits: Literal["first", "every"], rng: np.random.Generator) -> None:
        settings = OptionLearningSettings(initiation_visits=visits, initiation_steps=7, initiation_radius=0.0)
        subgoal = ball(0.0, radius=1.5)
        for _ in range(50):
            places = rng.integers(-1, 2, size=60).cumsum() + rng.integers(-6, 7)
            region = initiation_set(subgoal, [walk(places.tolist())], settings)
            assert not subgoal.contains(region.points).any()
            assert not region.contains(np.array([[-1.0], [0.0], [1.0]])).any()


class TestTransitions:
    settings = OptionLearningSettings(initiation_steps=2, initiation_radius=0.0)

    def of(self, *trajectories: LabelledTrajectory) -> list[tuple[float, int, float, float, bool]]:
        initiation = Region(np.array([[3.0], [4.0], [5.0]]), np.ones(1), 0.0)
        steps = option_transitions(DOOR, initiation, trajectories, self.settings)
        if steps is None:
            return []
        places = flatten(steps.states).ravel()
        assert len(set(places.tolist())) == len(places)
        return [
            (places[began], int(action), reward, places[led], bool(ends))
            for began, action, reward, led, ends in zip(*steps[1:], strict=True)
        ]

    def test_by_hand(self) -> None:
        """From 3 and 4 only; 2 lies outside, 5 is the subgoal."""
        assert self.of(walk([2, 3, 4, 5, 4, 3, 2, 3]), walk([4, 4, 5])) == [
            (3, RIGHT, -1.0, 4, False),
            (4, RIGHT, 0.0, 5, True),
            (4, LEFT, -1.0, 3, False),
            (3, LEFT, -100.0, 2, True),
            (4, LEFT, -1.0, 4, False),
            (4, RIGHT, 0.0, 5, True),
        ]

    def test_none(self) -> None:
        assert self.of() == []
        assert self.of(walk([0, 1, 2, 1])) == []
        assert self.of(walk([5, 6])) == []

    def test_a_terminal_state_inside_the_initiation_set_is_as_bad_as_leaving(self) -> None:
        assert self.of(walk([4, 3], terminated=True)) == [(4, LEFT, -100.0, 3, True)]
        assert self.of(walk([4, 3])) == [(4, LEFT, -1.0, 3, False)]  # truncated: nothing ended there
        assert self.of(walk([3, 4, 5], terminated=True))[-1] == (4, RIGHT, 0.0, 5, True)

    def test_rewards_are_those_of_the_settings(self) -> None:
        settings = OptionLearningSettings(step_reward=-2.0, subgoal_reward=7.0, leave_reward=-9.0)
        initiation = Region(np.array([[3.0], [4.0]]), np.ones(1), 0.0)
        steps = option_transitions(DOOR, initiation, [walk([3, 4, 5]), walk([3, 2])], settings)
        assert steps is not None
        assert steps.rewards.tolist() == [-2.0, 7.0, -9.0]


def known_values(policy: TabularPolicy) -> dict[float, list[float]]:
    return {float(s[0]): v.tolist() for s, v in zip(policy.states, policy.values, strict=True)}


class TestTable:
    def replay(self, *trajectories: LabelledTrajectory, gamma: float = 1.0, sweeps: int = 500) -> TabularPolicy:
        initiation = Region(np.array([[2.0], [3.0], [4.0]]), np.ones(1), 0.0)
        steps = option_transitions(DOOR, initiation, trajectories, OptionLearningSettings())
        assert steps is not None
        return replay_into_table(steps, 2, gamma=gamma, sweeps=sweeps)

    def test_corridor_by_hand(self) -> None:
        """2, 3 and 4 are in I; leaving it to 1 costs 100."""
        policy = self.replay(walk([2, 3, 4, 5]), walk([4, 3, 2, 1]))
        assert known_values(policy) == {2: [-100, -2], 3: [-3, -1], 4: [-2, 0]}
        assert policy.actions(np.array([[2.0], [3.0], [4.0]])).tolist() == [RIGHT] * 3

        policy = self.replay(walk([2, 3, 4, 5]), walk([4, 3, 2, 1]), gamma=0.5)
        assert known_values(policy) == {2: [-100, -1.5], 3: [-1.75, -1], 4: [-1.5, 0]}

    def test_a_way_out_is_worse_than_a_long_way(self) -> None:
        """From 2 the only tried ways are out of I (100) and around; the mean over what happened is learned."""
        slip = line([4.0, 3.0], [RIGHT])
        policy = self.replay(walk([3, 4, 5]), slip, slip)
        # Q(4, right) = (0 + 2 (−1 + V(3))) / 3 and V(3) = −1 + Q(4, right): Q = −4, V(3) = −5.
        assert known_values(policy)[4.0][RIGHT] == pytest.approx(-4.0)
        assert known_values(policy)[3.0][RIGHT] == pytest.approx(-5.0)

    def test_actions_never_tried_are_never_chosen(self) -> None:
        policy = self.replay(walk([4, 3, 2, 1]))
        assert known_values(policy) == {2: [-100, -math.inf], 3: [-101, -math.inf], 4: [-102, -math.inf]}
        assert policy.actions(np.array([[2.0], [4.0]])).tolist() == [LEFT, LEFT]

    def test_a_step_into_the_unknown_does_not_look_like_a_short_way(self) -> None:
        """A truncated trajectory ends in a state that nobody acted in: what follows is unknown, not good."""
        dead_end = labelled(trajectory_of([np.array([p]) for p in (2.0, 2.4, 2.45)], [LEFT, LEFT]))
        initiation = Region(np.array([[2.0], [3.0], [4.0]]), np.ones(1), 0.5)
        steps = option_transitions(DOOR, initiation, [walk([2, 3, 4, 5]), dead_end], OptionLearningSettings())
        assert steps is not None
        policy = replay_into_table(steps, 2, gamma=1.0, sweeps=500)
        assert known_values(policy) == {2: [-math.inf, -2], 3: [-math.inf, -1], 4: [-math.inf, 0]}

    def test_few_sweeps_and_many(self) -> None:
        trajectories = (walk([2, 3, 4, 5]), walk([4, 3, 2, 1]))
        assert known_values(self.replay(*trajectories, sweeps=1))[2.0] == [-100, -1]
        assert known_values(self.replay(*trajectories, sweeps=3)) == known_values(self.replay(*trajectories, sweeps=9))

    def test_is_value_iteration_on_a_random_grid(self, rng: np.random.Generator) -> None:
        """4 × 4 cells, slippery, subgoal in a corner; the oracle is value iteration on what happened."""
        subgoal, inside = 15, [s for s in range(15) if s not in (3, 12)]

        def successor(state: int, action: int) -> int:
            x, y = state % 4, state // 4
            dx, dy = [(0, -1), (0, 1), (-1, 0), (1, 0)][action]
            return min(max(x + dx, 0), 3) + 4 * min(max(y + dy, 0), 3)

        trajectories, happened = [], dict[tuple[int, int], list[int]]()
        for _ in range(40):
            state = int(rng.integers(15))
            states, actions = [state], list[int]()
            for _ in range(30):
                action = int(rng.integers(4))
                moved = action if rng.random() < 0.8 else int(rng.integers(4))
                following = successor(state, moved)
                if state in inside:
                    happened.setdefault((state, action), []).append(following)
                states.append(following)
                actions.append(action)
                state = following
            trajectories.append(line(states, actions))
        gamma, values = 0.95, np.zeros(16)
        q: dict[tuple[int, int], float] = {}
        for _ in range(2000):
            for pair, followers in happened.items():
                q[pair] = float(
                    np.mean(
                        [0.0 if f == subgoal else -1 + gamma * values[f] if f in inside else -50 for f in followers]
                    )
                )
            for state in inside:
                values[state] = max(q[state, a] for a in range(4) if (state, a) in q)

        settings = OptionLearningSettings(leave_reward=-50.0)
        initiation = Region(np.array(inside, dtype=np.float64)[:, None], np.ones(1), 0.0)
        steps = option_transitions(ball(float(subgoal)), initiation, trajectories, settings)
        assert steps is not None
        policy = replay_into_table(steps, 4, gamma=gamma, sweeps=2000)
        got = known_values(policy)
        assert sorted(got) == inside
        for (state, action), value in q.items():
            assert got[state][action] == pytest.approx(value, abs=1e-9)
        best = {s: max(range(4), key=lambda a, s=s: q.get((s, a), -math.inf)) for s in inside}  # type: ignore[misc]
        assert policy.actions(np.array(inside)).tolist() == list(best.values())


class TestNetwork:
    """A continuous corridor 0 … 10 with the door at 5, walked in noisy steps of 0.4: right before it, left behind."""

    door = ball(5.0, radius=0.4)

    def trajectories(self, seed: int) -> list[LabelledTrajectory]:
        rng = np.random.default_rng(seed)
        result = []
        for _ in range(40):
            place = rng.uniform(0.0, 10.0)
            places, actions = [place], list[int]()
            while abs(place - 5.0) > 0.4 and len(actions) < 200:
                action = int(rng.integers(2))
                place = float(np.clip(place + (0.4 if action == RIGHT else -0.4) + rng.normal(0.0, 0.05), 0.0, 10.0))
                places.append(place)
                actions.append(action)
            result.append(line(places, actions))
        return result

    def learn(self, seed: int, **settings: Any) -> SubgoalOption:
        option = learn_option(
            self.door, self.trajectories(seed), 2, OptionLearningSettings(**settings), generator(seed)
        )
        assert option is not None
        return option

    def test_learns_the_corridor(self) -> None:
        for seed in range(2):
            option = self.learn(seed)
            assert isinstance(option.option_policy, NetworkPolicy)  # chosen by `auto`: observations do not repeat
            places = option.initiation_set.points
            assert places.min() < 4.0
            assert places.max() > 6.0
            correct = np.where(places.ravel() < 5.0, RIGHT, LEFT)
            assert (option.policy(places) == correct).mean() > 0.9

    def test_one_seed_one_result_and_no_other_random_numbers(self) -> None:
        global_state = torch.get_rng_state()
        arrays = [self.learn(seed, network_updates=20).option_policy.arrays() for seed in (1, 1)]
        for name, array in arrays[0].items():
            np.testing.assert_array_equal(array, arrays[1][name])
        assert torch.equal(torch.get_rng_state(), global_state)
        steps = option_transitions(
            self.door, Region(np.array([[5.0]]), np.ones(1), 9.0), self.trajectories(1), OptionLearningSettings()
        )
        assert steps is not None
        first, second = (replay_into_network(steps, 2, gamma=0.9, updates=1, generator=generator(s)) for s in (0, 1))
        assert not np.array_equal(first.weights[0], second.weights[0])

    def test_a_feature_that_never_changes_and_images(self) -> None:
        states = np.zeros((3, 2, 2), dtype=np.uint8)
        states[:, 0, 0] = [0, 100, 200]
        began, actions, led = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([2, 1, 2, 2])
        rewards, ends = np.array([-9.0, -1.0, -9.0, 0.0]), np.array([True, False, True, True])
        steps = Transitions(states, began, actions, rewards, led, ends)
        policy = replay_into_network(steps, 2, gamma=0.9, updates=300, generator=generator())
        assert all(np.isfinite(array).all() for array in policy.arrays().values())
        assert policy.actions(states[:2]).tolist() == [1, 1]


class TestLearnOption:
    trajectories = tuple(walk([1, 2, 3, 4, 5, 6]) for _ in range(3)) + tuple(walk([4, 3, 2, 1]) for _ in range(3))

    def learn(self, *trajectories: LabelledTrajectory, **settings: Any) -> SubgoalOption | None:
        return learn_option(DOOR, trajectories, 2, OptionLearningSettings(**settings), generator(), name="door")

    def test_option(self) -> None:
        option = self.learn(*self.trajectories, initiation_steps=3, max_duration=12)
        assert option is not None
        assert (option.name, option.max_duration) == ("door", 12)
        bound = option.bind(flatten)
        places = np.arange(8.0)[:, None]
        assert np.flatnonzero(bound.initiation(places)).tolist() == [2, 3, 4]
        assert np.flatnonzero(bound.termination(places)).tolist() == [5]
        assert bound.policy(places[2:5]).tolist() == [RIGHT] * 3

    def test_any_iterable_of_trajectories(self) -> None:
        assert learn_option(DOOR, iter(self.trajectories), 2, OptionLearningSettings(), generator()) is not None

    def test_none_where_no_trajectory_leads_to_the_subgoal(self) -> None:
        assert self.learn() is None
        assert self.learn(walk([1, 2, 3, 4]), walk([9, 8, 7])) is None
        assert self.learn(walk([5, 6, 7])) is None

    @pytest.mark.parametrize("kind", ["table", "network"])
    def test_a_policy_of_features_needs_no_more_of_the_observation(self, kind: str) -> None:
        noise = np.random.default_rng(0)
        noisy = []
        for known in self.trajectories:
            places = known.features
            states = np.concatenate([places, noise.random((len(places), 3))], axis=1)
            noisy.append(replace(known, trajectory=replace(known.trajectory, states=states)))
        option = self.learn(*noisy, policy_input="features", value_function=kind, network_updates=300)
        assert option is not None
        bound = option.bind(lambda observations: np.asarray(observations)[:, :1])
        unseen = np.concatenate([np.arange(2.0, 5.0)[:, None], noise.random((3, 3))], axis=1)
        assert bound.policy(unseen).tolist() == [RIGHT] * 3
        further = learn_further(option, noisy[0], OptionLearningSettings(value_function="table"))
        assert further.policy_input == "features"
        assert (further is option) == (kind == "network")

    @pytest.mark.parametrize(
        ("kind", "n_walks", "expected"),
        [
            ("auto", 1, NetworkPolicy),
            ("auto", 2, TabularPolicy),  # 4 distinct observations in 8 steps
            ("table", 1, TabularPolicy),
            ("network", 5, NetworkPolicy),
        ],
    )
    def test_kind_of_value_function(self, kind: str, n_walks: int, expected: type) -> None:
        walks = [walk([1, 2, 3, 4, 5])] * n_walks
        option = self.learn(*walks, value_function=kind, network_updates=1)
        assert option is not None
        assert type(option.option_policy) is expected


class TestLearnFurther:
    settings = OptionLearningSettings(initiation_radius=0.0, value_function="table", gamma=1.0, step_size=0.5)

    def option(self) -> SubgoalOption:
        option = learn_option(DOOR, [walk([2, 3, 4, 5])], 2, self.settings, generator(), name="door")
        assert option is not None
        return option

    def values(self, option: SubgoalOption) -> dict[float, list[float]]:
        assert isinstance(option.option_policy, TabularPolicy)
        return known_values(option.option_policy)

    def test_by_hand(self) -> None:
        option = self.option()
        assert self.values(option) == {2: [-math.inf, -2], 3: [-math.inf, -1], 4: [-math.inf, 0]}
        # Backwards: Q(2, left) = −100 at once, being new; Q(3, left) = −1 − 2; then the slip from 4 is half learned.
        slip = line([4.0, 3.0, 2.0, 1.0], [RIGHT, LEFT, LEFT])
        further = learn_further(option, slip, self.settings)
        assert self.values(further) == {2: [-100, -2], 3: [-3, -1], 4: [-math.inf, -1]}
        assert self.values(option)[4.0] == [-math.inf, 0]  # the option before is untouched
        assert (further.name, further.max_duration) == ("door", 100)

    def test_nothing_to_teach(self) -> None:
        option = self.option()
        assert learn_further(option, walk([7, 8, 9]), self.settings) is option

    def test_new_observations_join_the_table_backwards(self) -> None:
        option = self.option()
        wide = SubgoalOption(
            option.subgoal, Region(option.initiation_set.points, np.ones(1), 0.4), option.option_policy
        )
        further = learn_further(wide, walk([2.8, 3.2, 4.0, 5.0]), self.settings)
        values = self.values(further)
        assert (values[3.2][RIGHT], values[2.8][RIGHT]) == (-1, -2)

    def test_a_step_into_the_unknown_teaches_nothing(self) -> None:
        option = self.option()
        wide = SubgoalOption(
            option.subgoal, Region(option.initiation_set.points, np.ones(1), 0.4), option.option_policy
        )
        for action in (LEFT, RIGHT):
            assert self.values(learn_further(wide, line([3.0, 2.8], [action]), self.settings)) == self.values(option)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        *(
            (name, (0, -1, 1.5, math.nan), "must be a whole number of at least 1, got ")
            for name in ("initiation_steps", "max_duration", "sweeps", "network_updates")
        ),
        ("initiation_radius", (-0.1, math.nan), "must be at least 0, got "),
        ("gamma", (0.0, 1.01, -1.0, math.nan), r"must be in \(0, 1\], got "),
        ("step_size", (0.0, 1.01, math.nan), r"must be in \(0, 1\], got "),
        *(
            (name, (math.nan, math.inf, -math.inf), "must be finite, got ")
            for name in ("step_reward", "subgoal_reward", "leave_reward")
        ),
        ("initiation_visits", ("last", None), "must be 'first' or 'every', got "),
        ("policy_input", ("state", None), "must be 'observation' or 'features', got "),
        ("value_function", ("tree", None), "must be 'auto', 'table' or 'network', got "),
    ],
)
def test_settings_out_of_range(name: str, values: Sequence[Any], message: str) -> None:
    for value in values:
        with pytest.raises(ValueError, match=rf"^{name} {message}{value!r}\.$"):
            OptionLearningSettings(**{name: value})


def test_every_numeric_setting_has_a_range() -> None:
    """A new field needs a row above."""
    assert {f.name for f in dataclasses.fields(OptionLearningSettings)} == {
        *("initiation_steps", "max_duration", "sweeps", "network_updates", "initiation_radius", "gamma", "step_size"),
        *(
            "step_reward",
            "subgoal_reward",
            "leave_reward",
            "initiation_visits",
            "value_function",
            "keep_learning",
            "grow",
        ),
        "policy_input",
    }
