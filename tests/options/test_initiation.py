from typing import Any

import numpy as np
import pytest

from sb3_options.density.regions import Region
from sb3_options.experience.observations import flatten
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import initiation_set, transitions_to
from tests.options.corridor import DOOR, LEFT, RIGHT, walk
from tests.support.helpers import ball


def centres(region: Region) -> list[float]:
    return sorted(region.points.ravel().tolist())


class TestInitiationSet:
    trajectories = (walk([1, 2, 3, 4, 5, 6, 7, 6, 5, 4]), walk([9, 8, 7]), walk([0, 1, 0, 4, 5]))

    @pytest.mark.parametrize(
        ("n", "expected"), [(1, [4]), (2, [0, 3, 4]), (3, [0, 1, 2, 3, 4]), (100, [0, 1, 2, 3, 4])]
    )
    def test_by_hand(self, n: int, expected: list[float]) -> None:
        settings = OptionLearningSettings(initiation_steps=n)
        region = initiation_set(DOOR, self.trajectories, settings)
        assert centres(region) == expected
        assert region.radius == 0.5

    def test_no_visit_and_no_trajectories(self) -> None:
        for trajectories in ([], [walk([1, 2, 3])]):
            region = initiation_set(DOOR, trajectories, OptionLearningSettings())
            assert region.points.shape == (0, 1)
            assert not region.contains(np.array([[5.0]])).any()

    def test_the_subgoal_is_never_in_it(self, rng: np.random.Generator) -> None:
        settings = OptionLearningSettings(initiation_steps=7, initiation_radius=0.0)
        subgoal = ball(0.0, radius=1.5)
        for _ in range(50):
            places = rng.integers(-1, 2, size=60).cumsum() + rng.integers(-6, 7)
            region = initiation_set(subgoal, [walk(places.tolist())], settings)
            assert not subgoal.contains(region.points).any()
            assert not region.contains(np.array([[-1.0], [0.0], [1.0]])).any()


class TestTransitions:
    def of(self, *trajectories: LabelledTrajectory, **settings: Any) -> list[tuple[float, int, float, float, bool]]:
        initiation = Region(np.array([[3.0], [4.0], [5.0]]), np.ones(1), 0.0)
        steps = transitions_to(DOOR, initiation, trajectories, OptionLearningSettings(**settings))
        if steps is None:
            return []
        places = flatten(steps.states).ravel()
        assert len(set(places.tolist())) == len(places)
        return [
            (places[began], int(action), reward, places[led], bool(ends))
            for began, action, reward, led, ends in zip(*steps[1:6], strict=True)
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
        assert [self.of(*walks) for walks in ([], [walk([0, 1, 2, 1])], [walk([5, 6])])] == [[], [], []]

    def test_a_terminal_state_inside_the_initiation_set_is_as_bad_as_leaving(self) -> None:
        assert self.of(walk([4, 3], terminated=True)) == [(4, LEFT, -100.0, 3, True)]
        assert self.of(walk([4, 3])) == [(4, LEFT, -1.0, 3, False)]  # truncated: nothing ended there
        assert self.of(walk([3, 4, 5], terminated=True))[-1] == (4, RIGHT, 0.0, 5, True)

    def test_the_reward_of_leaving_is_that_of_the_settings(self) -> None:
        steps = self.of(walk([3, 4, 5]), walk([3, 2]), leave_reward=-9.0)
        assert [reward for _, _, reward, _, _ in steps] == [-1.0, 0.0, -9.0]
