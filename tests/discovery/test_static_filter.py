from typing import Any

import numpy as np
import pytest

from sb3_options.discovery.filters import Filters
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.discovery.static_filter import near_start_and_goal, steps_from, steps_from_start_and_goal
from tests.support.helpers import line


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


class TestSteps:
    """Where all states are equally far apart, steps along the trajectory are the distance."""

    straight = np.arange(21)

    def test_keeps_what_is_more_than_2_steps_from_the_start_and_5_from_the_end(self) -> None:
        assert np.flatnonzero(steps_from_start_and_goal(self.straight, 2.0, 5.0)).tolist() == list(range(3, 15))

    def test_counts_from_the_first_visit_and_from_the_last(self) -> None:
        visits = np.array([0, 1, 2, 3, 4, 5, 6, 4, 7, 8, 9, 1, 10])
        #  states 1 and 2 begin within two steps, 4 is last seen 5 steps before the end, 3, 5 and 6 earlier
        assert np.flatnonzero(steps_from_start_and_goal(visits, 2.0, 5.0)).tolist() == [3, 5, 6]

    @pytest.mark.parametrize("rows", [[3], [3, 7], []])
    def test_steps_from_others(self, rows: list[int]) -> None:
        rng = np.random.default_rng(0)
        _, visits = np.unique(rng.integers(10, size=40), return_inverse=True)
        times = [t for t, row in enumerate(visits) if row in rows]
        expected = [
            min((abs(t - u) for t in np.flatnonzero(visits == row) for u in times), default=40) for row in range(10)
        ]
        assert steps_from(np.array(rows, dtype=int), visits).tolist() == expected


class TestOfAUser:
    def kept(self, static_filter: Any) -> Any:
        """Of a walk along 1, 2, 3 and back to 2."""
        filters = Filters(DiscoverySettings(scale=10.0), static_filter)
        walk = line([1, 2, 3, 2])
        filters.find_scale([walk])
        return filters.allowed(walk)

    def test_sees_scaled_features_of_the_start_and_the_last_state(self) -> None:
        seen: list[Any] = []

        def spy(features: Any, start: Any, end: Any) -> Any:  # numbers will do
            seen.extend([features.tolist(), start.tolist(), end.tolist()])
            return np.array([1, 0, 1])

        # The last state is where the trajectory ended, not the one that was new last.
        assert self.kept(spy).tolist() == [True, False, True]
        assert seen == [[[10], [20], [30]], [10], [20]]

    def test_of_another_shape(self) -> None:
        text = r"^static_filter must return shape \(3,\), one bool a state, got \(2,\)\.$"
        with pytest.raises(ValueError, match=text):
            self.kept(lambda f, s, e: np.ones(2, dtype=bool))
