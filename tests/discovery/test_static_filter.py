import math
from typing import Any

import numpy as np
import pytest

from sb3_options.discovery.static_filter import kept_by, near_start_and_goal


class TestStaticFilter:
    line = np.arange(21.0)[:, None]

    def test_default_keeps_what_is_farther_than_2_from_the_start_and_from_the_goal(self) -> None:
        kept = near_start_and_goal()(self.line, self.line[0], self.line[20])
        assert np.flatnonzero(kept).tolist() == list(range(3, 18))

    def test_distances_are_euclidean(self) -> None:
        features = np.array([[3.0, 4.0], [3.0, 4.1], [0.0, 5.1]])
        kept = near_start_and_goal(5.0, 0.0)(features, np.zeros(2), np.array([99.0, 0.0]))
        assert kept.tolist() == [False, True, True]

    def test_radius_0_drops_the_place_itself_only(self) -> None:
        kept = near_start_and_goal(0.0, 0.0)(self.line, self.line[4], self.line[7])
        assert np.flatnonzero(~kept).tolist() == [4, 7]

    @pytest.mark.parametrize(("start", "goal"), [(-1.0, 5.0), (2.0, -0.5), (math.nan, 1.0), (1.0, math.nan)])
    def test_out_of_range(self, start: float, goal: float) -> None:
        message = rf"^start_radius and goal_radius must be at least 0, got {start} and {goal}\.$"
        with pytest.raises(ValueError, match=message):
            near_start_and_goal(start, goal)


class TestKeptBy:
    def test_the_filter_sees_scaled_features_of_the_start_and_the_last_state(self) -> None:
        seen: list[Any] = []

        def spy(features: Any, start: Any, end: Any) -> Any:  # numbers will do
            seen.extend([features.tolist(), start.tolist(), end.tolist()])
            return np.array([1, 0, 1])

        # The last state is where the trajectory ended, not the one that was new last.
        kept = kept_by(spy, np.array([[1.0], [2.0], [3.0]]), 1, np.array([10.0]))
        assert seen == [[[10], [20], [30]], [10], [20]]
        assert kept.tolist() == [True, False, True]

    def test_of_another_shape(self) -> None:
        with pytest.raises(
            ValueError, match=r"^static_filter must return shape \(3,\), one bool a state, got \(2,\)\.$"
        ):
            kept_by(lambda f, s, e: np.ones(2, dtype=bool), np.zeros((3, 2)), 0, np.ones(2))
