"""Searches for a subgoal among a few places on a line, worked out by hand, and those that find none."""

import math
from typing import Any

import numpy as np
import pytest

from experiments.common.few_peaks import FewPeaks
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import described
from sb3_options.experience.success import success_by_steps
from tests.discovery.lines import SEARCHES, bags_of, found, on_a_line, peaks_of, settings_of, walked
from tests.support.helpers import ball, trajectory_of

BY_FIVE = (0, 2, 5, 9, 20), (1, 3.5, 5, 7, 21)
BY_FIVE_AND_TWELVE = (0, 2, 5, 9, 12, 20), (1, 3.5, 5, 7, 12, 21)


def searches_of(discovery: Discovery, successes: list[bool]) -> tuple[list[int], list[int]]:
    """After which of so many walks it searches, and finds a subgoal."""
    searched, finds = [], []
    for n, success in enumerate(successes, start=1):
        discovery.add(*on_a_line(0, 5, 20, success=success))
        spent = discovery.diary.spent
        finds += [n] if discovery.search() is not None else []
        searched += [n] if discovery.diary.spent > spent else []
    return searched, finds


class TestSearch:
    def test_by_hand(self) -> None:
        """Both walks pass 5; λ = 1/2 and a threshold of 0.4 want one search."""
        discovery = walked(Discovery(settings_of()), *BY_FIVE)
        assert found(discovery) == [5.0]
        (finding,) = discovery.found
        # −log p = −2 log(1 − (1 − e⁰)·…) = 0: both bags hold the very place.
        assert finding.log_density == pytest.approx(0.0, abs=1e-12)
        assert finding.subgoal.radius == 0.5
        completed = peaks_of(discovery).completed
        assert completed is not None
        assert [len(bag) for bag in completed.positive] == [3, 3]

    def test_persistence_takes_several_searches(self) -> None:
        discovery = walked(Discovery(settings_of(threshold=0.8)), *BY_FIVE)
        assert [found(discovery) for _ in range(3)] == [None, None, [5.0]]

    @pytest.mark.parametrize("search", SEARCHES)
    def test_found_subgoals_are_taken(self, search: str) -> None:
        discovery = walked(Discovery(settings_of(search=search, spacing=3.0)), *BY_FIVE_AND_TWELVE)
        assert sorted(p for _ in range(2) for p in found(discovery) or []) == [5.0, 12.0]
        centres = [f.subgoal.points[0, 0] for f in discovery.found]
        for _ in range(20):
            subgoal = found(discovery)
            assert subgoal is None or min(abs(subgoal[0] - c) for c in centres) > 3.0
            centres += subgoal or []
        # In the end nothing is left to search, which is no error.
        assert bags_of(discovery) is None

    @pytest.mark.parametrize("search", SEARCHES)
    def test_so_are_those_that_had_an_option_before(self, search: str) -> None:
        discovery = Discovery(settings_of(search=search, spacing=3.0), taken=[ball(5.0)])
        assert found(walked(discovery, *BY_FIVE_AND_TWELVE)) == [12.0]

    @pytest.mark.parametrize("search", SEARCHES)
    def test_negative_bags_speak_against(self, search: str) -> None:
        for strength, expected in ((1.0, [12.0]), (0.0, [5.0])):
            discovery = Discovery(settings_of(search=search, negative_strength=strength))
            walked(discovery, (0, 2, 5, 12, 20), (1, 3.5, 5, 12, 21))
            discovery.add(*on_a_line(0, 4, 5, 6, 30, success=False))
            assert found(discovery) == expected

    @pytest.mark.parametrize("search", SEARCHES)
    def test_too_many_places_are_accidents_and_a_wide_plateau_is_open_space(self, search: str) -> None:
        wide = (0, 2, 5, 6, 7, 8, 9, 20), (1, 3.5, 5, 6, 7, 8, 9, 21)
        for method, ways, expected in (
            (FewPeaks(1), BY_FIVE_AND_TWELVE, None),
            (FewPeaks(2), BY_FIVE_AND_TWELVE, [5.0]),
            (FewPeaks(9, 1.0), wide, None),
            (FewPeaks(9, 2.0), wide, [7.0]),
        ):
            assert found(walked(Discovery(settings_of(search=search), method), *ways)) == expected

    def test_a_peak_where_nobody_can_stand_moves_to_the_nearest_instance(self) -> None:
        discovery = walked(Discovery(settings_of(search="gradient")), (0, 5.0, 20), (1, 5.5, 21))
        assert found(discovery) in ([5.0], [5.5])

    @pytest.mark.parametrize("search", SEARCHES)
    def test_only_the_last_trajectories_count(self, search: str) -> None:
        discovery = Discovery(settings_of(search=search, capacity=2))
        walked(discovery, *[(0, 5, 20)] * 5, *[(0, 9, 20)] * 2)
        assert len(discovery.database) == 2
        assert found(discovery) == [9.0]

    def test_success_and_filter_are_the_users(self) -> None:
        discovery = Discovery(
            settings_of(), success=success_by_steps(3), static_filter=lambda f, start, end: f[:, 0] == 7.0
        )
        assert not discovery.add(*on_a_line(0, 7, 8, 9, 10)).success
        assert discovery.search() is None
        assert discovery.add(*on_a_line(0, 7, 8)).success
        assert found(discovery) == [7.0]

    def test_the_bag_of_a_success_is_the_way_it_took(self) -> None:
        """What a failure visited speaks against a concept also where it went in a loop."""
        bags = {}
        for loops in ("erase", "keep"):
            discovery = Discovery(settings_of(loops=loops))
            discovery.add(*on_a_line(0, 5, 7, 5, 9, 20))
            discovery.add(*on_a_line(0, 5, 7, 5, 9, 20, success=False))
            discovery.search()
            evidence = peaks_of(discovery).evidence
            assert evidence is not None
            bags[loops] = [bag.ravel().tolist() for bag in evidence.positive]
            assert [bag.ravel().tolist() for bag in evidence.negative] == [[5, 7, 9]]
        assert bags == {"erase": [[5, 9]], "keep": [[5, 7, 9]]}

    @pytest.mark.parametrize("search", SEARCHES)
    def test_only_what_the_ways_near_it_lead_through_is_an_instance(self, search: str) -> None:
        """Six ways lead through 10; near 30, two through each of three places a unit from each other."""
        discovery = Discovery(settings_of(search=search, loops="erase", min_passing=0.7, min_positive=3))
        walked(discovery, *((0, 10, 30 + way % 3, 60) for way in range(6)))
        assert found(discovery) == pytest.approx([10.0], abs=1e-6)

    @pytest.mark.parametrize("search", SEARCHES)
    def test_a_leak_lets_one_of_two_ways_count(self, search: str) -> None:
        """Without one, a place between the two ways is as dense as it gets, and nobody was there."""
        ways = [5.0, 9.0, 5.0, 5.0, 9.0, 5.0, 5.0]

        def best(leak: float) -> float:
            discovery = Discovery(settings_of(search=search, min_positive=3, leak=leak))
            walked(discovery, *((100.0 + 9 * i, way, 200.0 + 9 * i) for i, way in enumerate(ways))).search()
            density = discovery.method.log_density(np.array([[5.0], [7.0]]))
            assert density is not None
            return float(density[0] - density[1])

        assert best(0.0) < 0 < best(0.2)

    @pytest.mark.parametrize("strength", [0.1, 0.0])
    def test_the_more_successes_there_are_the_rarer_are_searches(self, strength: float) -> None:
        """With a growth of a fifth, 2 new trajectories up to 10 successes, 3 up to 15. The first here is a failure."""
        discovery = Discovery(settings_of(search_growth=0.2, negative_strength=strength, threshold=0.99))
        assert searches_of(discovery, [False, *[True] * 14])[0] == [1, 2, 3, 4, 5, 6, 8, 10, 13]

    def test_once_nothing_is_left_searches_are_rarer(self) -> None:
        """Only state 5 may be a subgoal. The share of new ones that a search waits for is 1 − 0.8⁵ after that."""
        discovery = Discovery(settings_of(search_growth=0.2, threshold=0.1, min_positive=1))
        assert searches_of(discovery, [True] * 25) == ([1, 2, 7, 22], [1])


class TestWithoutDistances:
    """One-hot codes are all equally far apart: radii are steps along the trajectory."""

    def discovery(self, kind: str, **changes: Any) -> Discovery:
        discovery = Discovery(settings_of(**{"start_radius": 2.0, "goal_radius": 5.0, **changes}), kind=kind)
        for _ in range(4):
            trajectory = trajectory_of(list(np.eye(12)), is_success=True)
            discovery.add(trajectory, np.asarray(trajectory.states))
        return discovery

    def left(self, discovery: Discovery) -> list[int]:
        bags = bags_of(discovery)
        return [] if bags is None else np.unique(np.concatenate(bags.positive).argmax(axis=1)).tolist()

    @pytest.mark.parametrize("kind", ["categorical", "identity"])
    def test_start_and_goal(self, kind: str) -> None:
        assert self.left(self.discovery(kind)) == [3, 4, 5]

    def test_what_has_an_option(self) -> None:
        discovery = self.discovery("categorical", spacing=1.0, decay=0.9, threshold=0.0)
        subgoal = discovery.search()
        assert subgoal is not None
        (taken,) = subgoal.points.argmax(axis=1)
        assert self.left(discovery) == [state for state in (3, 4, 5) if abs(state - taken) > 1]

    def test_a_filter_of_the_users_goes_before(self) -> None:
        discovery = self.discovery("categorical")
        peaks_of(discovery).filters.static_filter = lambda f, start, end: f[:, 8] > 0
        assert self.left(discovery) == [8]

    def test_a_state_is_named(self) -> None:
        assert described(np.eye(64)[57], "categorical") == "state 57"
        assert described(np.array([1.5, 2.0]), "environment") == "1.5, 2"
        assert described(np.arange(7.0), None) == "0, 1, 2, 3, 4, 5, …"


class TestNothingToFind:
    def test_no_trajectories(self) -> None:
        assert Discovery().search() is None

    def test_failures_only(self) -> None:
        discovery = Discovery(settings_of())
        assert searches_of(discovery, [False] * 20)[1] == []
        assert peaks_of(discovery).evidence is None
        assert peaks_of(discovery).peaks == []

    @pytest.mark.parametrize("search", SEARCHES)
    def test_a_single_instance(self, search: str) -> None:
        discovery = walked(Discovery(settings_of(search=search, negative_strength=0.0)), (0, 5, 20))
        assert found(discovery) == pytest.approx([5.0], abs=1e-6)
        assert discovery.search() is None

    def test_a_trajectory_of_one_observation(self) -> None:
        assert walked(Discovery(settings_of()), (0,), (3, 3, 3)).search() is None


class TestAdd:
    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_features_that_are_not_finite(self, bad: float) -> None:
        discovery = Discovery(settings_of())
        trajectory, _ = on_a_line(0, 5, 20)
        features = np.array([[0.0], [bad], [20.0]])
        message = r"^a trajectory has rewards, features or observations that are NaN or infinite; .*check_finite"
        with pytest.raises(ValueError, match=message):
            discovery.add(trajectory, features)
        assert len(discovery.database) == 0
        discovery.add(*on_a_line(0, 5, 20))
        assert found(discovery) == [5.0]

    @pytest.mark.parametrize("shape", [(3,), (2, 1), (4, 1), (3, 1, 1), ()])
    def test_features_that_do_not_fit(self, shape: tuple[int, ...]) -> None:
        text = r"^features must have shape \(m, d\), one row for each of the trajectory's 3 distinct observations, got "
        with pytest.raises(ValueError, match=text):
            Discovery().add(on_a_line(0, 5, 20)[0], np.zeros(shape))

    def test_label_and_features(self) -> None:
        trajectory, features = on_a_line(0, 5, 20)
        labelled = Discovery().add(trajectory, features.astype(np.float32))
        assert labelled.trajectory is trajectory
        assert labelled.success is True
        assert labelled.features.dtype == np.float64
