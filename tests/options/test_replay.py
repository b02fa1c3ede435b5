import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
import torch

from sb3_options.density.regions import Region
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options import creation
from sb3_options.options.creation import learn_option
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from sb3_options.options.replay import replay_into_network, replay_into_table
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import Transitions, transitions_to, value_keys
from tests.options.corridor import DOOR, LEFT, RIGHT, generator, known_values, walk
from tests.support.helpers import ball, labelled, line, trajectory_of


def saved_steps(
    trajectories: Iterable[LabelledTrajectory], places: Any, *, to: Region = DOOR, radius: float = 0.0, **settings: Any
) -> Transitions:
    """The saved steps of the task to get there from places on a line."""
    initiation = Region(np.array(places, dtype=np.float64)[:, None], np.ones(1), radius)
    steps = transitions_to(to, initiation, trajectories, OptionLearningSettings(**settings))
    assert steps is not None
    return steps


class TestTable:
    def replay(self, *trajectories: LabelledTrajectory, gamma: float = 1.0, sweeps: int = 500) -> TabularPolicy:
        return replay_into_table(saved_steps(trajectories, [2, 3, 4]), 2, gamma=gamma, sweeps=sweeps)

    def test_corridor_by_hand(self) -> None:
        """2, 3 and 4 are in I; leaving it to 1 costs 100."""
        policy = self.replay(walk([2, 3, 4, 5]), walk([4, 3, 2, 1]))
        assert known_values(policy) == {2: [-100, -2], 3: [-3, -1], 4: [-2, 0]}
        assert policy.actions(np.array([[2.0], [3.0], [4.0]])).tolist() == [RIGHT] * 3

        # It ends when nothing changes: so many sweeps would take years.
        policy = self.replay(walk([2, 3, 4, 5]), walk([4, 3, 2, 1]), gamma=0.5, sweeps=10**12)
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
        steps = saved_steps([walk([2, 3, 4, 5]), dead_end], [2, 3, 4], radius=0.5)
        policy = replay_into_table(steps, 2, gamma=1.0, sweeps=500)
        assert known_values(policy) == {2: [-math.inf, -2], 3: [-math.inf, -1], 4: [-math.inf, 0]}

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
        for _ in range(600):
            for pair, followers in happened.items():
                returns = [0.0 if f == subgoal else -1 + gamma * values[f] if f in inside else -50 for f in followers]
                q[pair] = sum(returns) / len(returns)
            for state in inside:
                values[state] = max(q[state, a] for a in range(4) if (state, a) in q)

        steps = saved_steps(trajectories, inside, to=ball(float(subgoal)), leave_reward=-50.0)
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

    def test_learns_the_corridor(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(creation, "NETWORK_UPDATES", 500)
        for seed in range(2):
            option = self.learn(seed)
            assert isinstance(option.option_policy, NetworkPolicy)  # chosen by `auto`: observations do not repeat
            places = option.initiation_set.points
            assert places.min() < 4.0
            assert places.max() > 6.0
            correct = np.where(places.ravel() < 5.0, RIGHT, LEFT)
            assert (option.policy(places) == correct).mean() > 0.9

    def test_one_seed_one_result_and_no_other_random_numbers(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(creation, "NETWORK_UPDATES", 20)
        global_state = torch.get_rng_state()
        arrays = [self.learn(seed).option_policy.arrays() for seed in (1, 1)]
        for name, array in arrays[0].items():
            np.testing.assert_array_equal(array, arrays[1][name])
        assert torch.equal(torch.get_rng_state(), global_state)
        steps = saved_steps(self.trajectories(1), [5], to=self.door, radius=9.0)
        first, second = (replay_into_network(steps, 2, gamma=0.9, updates=1, generator=generator(s)) for s in (0, 1))
        assert not np.array_equal(first.weights[0], second.weights[0])


@pytest.mark.parametrize("of", [np.array, lambda x: {"x": np.array(x), "y": np.zeros(len(x), np.int64)}])
def test_value_keys_are_equal_exactly_if_values_are(of: Any) -> None:
    zero, minus_zero, one = value_keys(of([[0.0, 1.0], [-0.0, 1.0], [1.0, 1.0]]))
    assert zero == minus_zero != one
    of_bytes = value_keys(of(np.array([[[1]], [[2]], [[1]]], np.uint8)))
    assert of_bytes[0] == of_bytes[2] != of_bytes[1]
