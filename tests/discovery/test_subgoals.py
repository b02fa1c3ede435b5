import dataclasses
import math
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.density.regions import Region
from sb3_options.discovery.settings import CATEGORICAL_SCALE, DiscoverySettings, default_scale, described
from sb3_options.discovery.subgoals import SubgoalDiscovery
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.recording import EpisodeRecorder
from sb3_options.experience.success import success_by_steps
from sb3_options.experience.trajectories import Trajectory
from tests.support.helpers import ball, trajectory_of

DOORWAY = (10.0, 5.0)
N_WALKS = 40
SMALL: dict[str, Any] = {
    "min_positive": 1,
    "start_radius": 0.0,
    "goal_radius": 0.0,
    "search": "exhaustive",
    "decay": 0.5,
    "threshold": 0.4,
    "negative_strength": 1.0,
    "loops": "keep",
    "min_passing": 0.0,
    "leak": 0.0,
    "search_growth": 0.0,
}
"""The paper's bags and diverse density, of few trajectories, which may be searched again and again."""


SEARCHES: tuple[Literal["gradient", "exhaustive", "incremental"], ...] = ("gradient", "exhaustive", "incremental")


def settings_of(**changes: Any) -> DiscoverySettings:
    return DiscoverySettings(**{**SMALL, **changes})


def on_a_line(*places: float, success: bool = True) -> tuple[Trajectory, FloatArray]:
    """A trajectory and its features: the places themselves."""
    trajectory = trajectory_of([np.array([float(p)]) for p in places], is_success=success)
    return trajectory, np.asarray(trajectory.states)


def found(discovery: SubgoalDiscovery) -> list[float] | None:
    subgoal = discovery.search()
    return None if subgoal is None else subgoal.points.ravel().tolist()


@pytest.fixture(scope="module")
def walks() -> list[list[tuple[Trajectory, FloatArray]]]:
    """For each of 6 seeds the first 40 successful trajectories of a random walk, failures left out."""
    result = []
    for seed in range(6):
        env = gym.make("sb3_options/TwoRooms-v0")
        rng = np.random.default_rng(seed)
        features = env.get_wrapper_attr("concept_features")
        recorder, kept = EpisodeRecorder(), list[tuple[Trajectory, FloatArray]]()
        observation, _ = env.reset(seed=seed)
        recorder.begin(observation)
        while len(kept) < N_WALKS:
            action = int(rng.integers(4))
            observation, reward, terminated, truncated, info = env.step(np.int64(action))
            recorder.record(action, float(reward), observation)
            if terminated or truncated:
                recorder.end(terminated=terminated, truncated=truncated, is_success=info["is_success"])
                trajectory = recorder.finished[-1]
                if trajectory.is_success:
                    kept.append((trajectory, features(trajectory.states)))
                observation, _ = env.reset()
                recorder.begin(observation)
        result.append(kept)
    return result


class TestTwoRooms:
    @pytest.mark.parametrize("search", SEARCHES)
    def test_random_walks_lead_to_the_doorway(
        self,
        walks: list[list[tuple[Trajectory, FloatArray]]],
        search: Literal["gradient", "exhaustive", "incremental"],
    ) -> None:
        near = 0
        for trajectories in walks:
            discovery = SubgoalDiscovery(DiscoverySettings(search=search, search_growth=0.0), kind="environment")
            for trajectory, features in trajectories:
                discovery.add(trajectory, features)
            subgoals = [discovery.search() for _ in range(2)]  # 1 − λⁿ > 0.4
            assert subgoals[0] is None
            subgoal = subgoals[1]
            near += subgoal is not None and bool(np.linalg.norm(subgoal.points[0] - DOORWAY) <= 1.0)
        assert near >= 5

    @pytest.mark.parametrize(("noise", "searches"), [(0.0, 2), (0.2, 4)])
    def test_a_state_that_is_known_to_cut_needs_to_persist_for_less(
        self, walks: list[list[tuple[Trajectory, FloatArray]]], noise: float, searches: int
    ) -> None:
        """The doorway of positions that are seen again; where they never are, it persists as long as before."""
        rng = np.random.default_rng(0)
        discovery = SubgoalDiscovery(DiscoverySettings(search_growth=0.0), kind="environment")
        for trajectory, features in walks[0]:
            discovery.add(trajectory, features + rng.uniform(-noise, noise, features.shape))
        subgoals = [discovery.search() for _ in range(searches)]
        assert subgoals[:-1] == [None] * (searches - 1)
        subgoal = subgoals[-1]
        assert subgoal is not None
        assert np.linalg.norm(subgoal.points[0] - DOORWAY) <= 1.0 + 2 * noise

    @pytest.mark.parametrize("capacity", [100, 20])
    def test_incremental_search_finds_what_exhaustive_search_finds(
        self, walks: list[list[tuple[Trajectory, FloatArray]]], capacity: int
    ) -> None:
        """The first subgoal of every training, within a cell and an episode; a capacity of 20 evicts."""
        same = 0
        for trajectories in walks[:4]:
            firsts = []
            for search in SEARCHES[1:]:
                discovery = SubgoalDiscovery(DiscoverySettings(search=search, capacity=capacity), kind="environment")
                firsts.append((N_WALKS, np.zeros(2)))
                for episode, (trajectory, features) in enumerate(trajectories):
                    discovery.add(trajectory, features)
                    subgoal = discovery.search()
                    if subgoal is not None:
                        firsts[-1] = (episode, subgoal.points[0])
                        break
            (one, place), (other, again) = firsts
            same += abs(one - other) <= 1 and bool(np.linalg.norm(place - again) <= 1.0)
        assert same >= 3

    @pytest.mark.parametrize("search", ["gradient", "incremental"])
    def test_one_seed_one_result(
        self, walks: list[list[tuple[Trajectory, FloatArray]]], search: Literal["gradient", "incremental"]
    ) -> None:
        results = []
        for _ in range(2):
            discovery = SubgoalDiscovery(DiscoverySettings(search=search), kind="environment")
            for trajectory, features in walks[0][:25]:
                discovery.add(trajectory, features)
                discovery.search()
            results.append(
                [(f.subgoal.points.tolist(), f.log_density) for f in discovery.found]
                + [(c.point.tolist(), c.average) for c in discovery.tracker.concepts]
            )
        assert results[0] == results[1]


class TestSearch:
    def test_by_hand(self) -> None:
        """Both walks pass 5; λ = 1/2 and a threshold of 0.4 want one search."""
        discovery = SubgoalDiscovery(settings_of())
        discovery.add(*on_a_line(0, 2, 5, 9, 20))
        discovery.add(*on_a_line(1, 3.5, 5, 7, 21))
        assert found(discovery) == [5.0]
        (finding,) = discovery.found
        # −log p = −2 log(1 − (1 − e⁰)·…) = 0: both bags hold the very place.
        assert finding.log_density == pytest.approx(0.0, abs=1e-12)
        assert finding.subgoal.radius == 0.5
        assert finding.bags is not None
        assert finding.bags.lengths == (3, 3)

    def test_persistence_takes_several_searches(self) -> None:
        discovery = SubgoalDiscovery(settings_of(threshold=0.8))
        discovery.add(*on_a_line(0, 2, 5, 9, 20))
        discovery.add(*on_a_line(1, 3.5, 5, 7, 21))
        assert [found(discovery) for _ in range(3)] == [None, None, [5.0]]

    @pytest.mark.parametrize("search", ["exhaustive", "incremental"])
    def test_found_subgoals_are_taken(self, search: str) -> None:
        discovery = SubgoalDiscovery(settings_of(search=search, spacing=3.0))
        discovery.add(*on_a_line(0, 2, 5, 9, 12, 20))
        discovery.add(*on_a_line(1, 3.5, 5, 7, 12, 21))
        assert sorted(p for _ in range(2) for p in found(discovery) or []) == [5.0, 12.0]
        centres = [f.subgoal.points[0, 0] for f in discovery.found]
        for _ in range(20):
            subgoal = found(discovery)
            assert subgoal is None or min(abs(subgoal[0] - c) for c in centres) > 3.0
            centres += subgoal or []
        # In the end nothing is left to search, which is no error.
        assert discovery.bags() is None

    @pytest.mark.parametrize("search", ["exhaustive", "incremental"])
    def test_so_are_those_that_had_an_option_before(self, search: Literal["exhaustive", "incremental"]) -> None:
        discovery = SubgoalDiscovery(settings_of(search=search, spacing=3.0), taken=[ball(5.0)])
        discovery.add(*on_a_line(0, 2, 5, 9, 12, 20))
        discovery.add(*on_a_line(1, 3.5, 5, 7, 12, 21))
        assert found(discovery) == [12.0]

    @pytest.mark.parametrize("search", ["exhaustive", "incremental"])
    def test_negative_bags_speak_against(self, search: str) -> None:
        for negative_bags, expected in ((True, [12.0]), (False, [5.0])):
            discovery = SubgoalDiscovery(
                settings_of(search=search, negative_bags=negative_bags, max_places=1, peak_radius=100.0)
            )
            discovery.add(*on_a_line(0, 2, 5, 12, 20))
            discovery.add(*on_a_line(1, 3.5, 5, 12, 21))
            discovery.add(*on_a_line(0, 4, 5, 6, 30, success=False))
            assert found(discovery) == expected

    @pytest.mark.parametrize("search", ["exhaustive", "incremental"])
    def test_too_many_places_are_accidents(self, search: str) -> None:
        for max_places, expected in ((1, None), (2, [5.0])):
            discovery = SubgoalDiscovery(settings_of(search=search, max_places=max_places))
            discovery.add(*on_a_line(0, 2, 5, 9, 12, 20))
            discovery.add(*on_a_line(1, 3.5, 5, 7, 12, 21))
            assert found(discovery) == expected

    @pytest.mark.parametrize("search", ["exhaustive", "incremental"])
    def test_a_wide_plateau_is_open_space(self, search: str) -> None:
        for max_extent, expected in ((1.0, None), (2.0, [7.0])):
            discovery = SubgoalDiscovery(settings_of(search=search, max_extent=max_extent))
            discovery.add(*on_a_line(0, 2, 5, 6, 7, 8, 9, 20))
            discovery.add(*on_a_line(1, 3.5, 5, 6, 7, 8, 9, 21))
            assert found(discovery) == expected

    def test_a_peak_where_nobody_can_stand_moves_to_the_nearest_instance(self) -> None:
        discovery = SubgoalDiscovery(settings_of(search="gradient"))
        discovery.add(*on_a_line(0, 5.0, 20))
        discovery.add(*on_a_line(1, 5.5, 21))
        subgoal = found(discovery)
        assert subgoal in ([5.0], [5.5])
        bags = discovery.found[0].bags
        assert bags is not None
        assert bags.n_positive == 2

    @pytest.mark.parametrize("search", ["exhaustive", "incremental"])
    def test_only_the_last_trajectories_count(self, search: str) -> None:
        discovery = SubgoalDiscovery(settings_of(search=search, capacity=2))
        for _ in range(5):
            discovery.add(*on_a_line(0, 5, 20))
        for _ in range(2):
            discovery.add(*on_a_line(0, 9, 20))
        assert len(discovery.database) == 2
        assert found(discovery) == [9.0]

    def test_success_and_filter_are_the_users(self) -> None:
        discovery = SubgoalDiscovery(
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
            discovery = SubgoalDiscovery(settings_of(loops=loops))
            discovery.add(*on_a_line(0, 5, 7, 5, 9, 20))
            discovery.add(*on_a_line(0, 5, 7, 5, 9, 20, success=False))
            discovery.search()
            assert discovery.last.evidence is not None
            bags[loops] = [bag.ravel().tolist() for bag in discovery.last.evidence.positive]
            assert [bag.ravel().tolist() for bag in discovery.last.evidence.negative] == [[5, 7, 9]]
        assert bags == {"erase": [[5, 9]], "keep": [[5, 7, 9]]}

    @pytest.mark.parametrize("search", SEARCHES)
    def test_only_what_the_ways_near_it_lead_through_is_an_instance(self, search: str) -> None:
        """Six ways lead through 10; near 30, two through each of three places a unit from each other."""
        discovery = SubgoalDiscovery(settings_of(search=search, loops="erase", min_passing=0.7, min_positive=3))
        for way in range(6):
            discovery.add(*on_a_line(0, 10, 30 + way % 3, 60))
        assert found(discovery) == pytest.approx([10.0], abs=1e-6)
        assert discovery.last.evidence is not None
        assert [bag.ravel().tolist() for bag in discovery.last.evidence.positive] == [[10.0]] * 6

    def test_few_ways_show_nothing(self) -> None:
        discovery = SubgoalDiscovery(settings_of(min_passing=0.7))
        for n in range(1, 4):
            discovery.add(*on_a_line(0, 10, 60))
            assert (discovery.search() is None) == (n < 3)

    @pytest.mark.parametrize("search", SEARCHES)
    def test_a_leak_lets_one_of_two_ways_count(self, search: str) -> None:
        """Without one, a place between the two ways is as dense as it gets, and nobody was there."""
        ways = [5.0, 9.0, 5.0, 5.0, 9.0, 5.0, 5.0]

        def best(leak: float) -> float:
            discovery = SubgoalDiscovery(settings_of(search=search, min_positive=3, leak=leak))
            for i, way in enumerate(ways):
                discovery.add(*on_a_line(100.0 + 9 * i, way, 200.0 + 9 * i))
            discovery.search()
            assert discovery.last.bags is not None
            density = discovery.engine().log_density(np.array([[5.0], [7.0]]), discovery.last.bags)
            return float(density[0] - density[1])

        assert best(0.0) < 0 < best(0.2)

    @pytest.mark.parametrize("negative_bags", [True, False])
    def test_the_more_successes_there_are_the_rarer_are_searches(self, negative_bags: bool) -> None:
        """With a growth of a fifth, 2 new trajectories up to 10 successes, 3 up to 15. The first here is a failure."""
        never = {"threshold": 0.99, "cut_threshold": 0.99}
        discovery = SubgoalDiscovery(settings_of(search_growth=0.2, negative_bags=negative_bags, **never))
        searched = []
        for n in range(1, 16):
            discovery.add(*on_a_line(0, 5, 20, success=n > 1))
            seconds = discovery.seconds
            discovery.search()
            searched += [n] if discovery.seconds > seconds else []
        assert searched == [1, 2, 3, 4, 5, 6, 8, 10, 13]

    def test_once_nothing_is_left_searches_are_rarer(self) -> None:
        """Only state 5 may be a subgoal. The share of new ones that a search waits for is 1 − 0.8⁵ after that."""
        discovery = SubgoalDiscovery(settings_of(search_growth=0.2, threshold=0.1, min_positive=1))
        found, searched = [], []
        for n in range(1, 26):
            discovery.add(*on_a_line(0, 5, 20))
            seconds = discovery.seconds
            found += [n] if discovery.search() is not None else []
            searched += [n] if discovery.seconds > seconds else []
        assert found == [1]
        assert searched == [1, 2, 7, 22]

    def test_seconds_add_up(self) -> None:
        discovery = SubgoalDiscovery(settings_of(threshold=0.9))
        discovery.add(*on_a_line(0, 5, 20))
        seconds = 0.0
        for _ in range(3):
            discovery.search()
            seconds += discovery.last.seconds
        assert discovery.seconds == pytest.approx(seconds)
        assert seconds > 0.0


class TestWithoutDistances:
    """One-hot codes are all equally far apart: radii are steps along the trajectory."""

    def discovery(self, kind: str, **changes: Any) -> SubgoalDiscovery:
        discovery = SubgoalDiscovery(settings_of(**{"start_radius": 2.0, "goal_radius": 5.0, **changes}), kind=kind)
        for _ in range(4):
            trajectory = trajectory_of(list(np.eye(12)), is_success=True)
            discovery.add(trajectory, np.asarray(trajectory.states))
        return discovery

    def left(self, discovery: SubgoalDiscovery) -> list[int]:
        bags = discovery.bags()
        return [] if bags is None else np.unique(bags.positive().instances.numpy().argmax(axis=1)).tolist()

    @pytest.mark.parametrize("kind", ["categorical", "identity"])
    def test_start_and_goal(self, kind: str) -> None:
        assert self.left(self.discovery(kind)) == [3, 4, 5]

    def test_what_has_an_option(self) -> None:
        discovery = self.discovery("categorical", max_places=9, spacing=1.0, decay=0.9, threshold=0.0)
        subgoal = discovery.search()
        assert subgoal is not None
        (taken,) = subgoal.points.argmax(axis=1)
        assert self.left(discovery) == [state for state in (3, 4, 5) if abs(state - taken) > 1]

    def test_a_filter_of_the_users_goes_before(self) -> None:
        discovery = self.discovery("categorical")
        discovery._maker.static_filter = lambda f, start, end: f[:, 8] > 0
        assert self.left(discovery) == [8]

    def test_a_state_is_named(self) -> None:
        assert described(np.eye(64)[57], "categorical") == "state 57"
        assert described(np.array([1.5, 2.0]), "environment") == "1.5, 2"
        assert described(np.arange(7.0), None) == "0, 1, 2, 3, 4, 5, …"


class TestNothingToFind:
    def test_no_trajectories(self) -> None:
        assert SubgoalDiscovery().search() is None

    def test_failures_only(self) -> None:
        discovery = SubgoalDiscovery(settings_of())
        for _ in range(20):
            discovery.add(*on_a_line(0, 5, 20, success=False))
            assert discovery.search() is None
        assert discovery.last.bags is None
        assert discovery.last.peaks == []

    def test_successes_only(self) -> None:
        discovery = SubgoalDiscovery(settings_of())
        discovery.add(*on_a_line(0, 5, 20))
        assert found(discovery) == [5.0]

    def test_too_few_successes(self) -> None:
        discovery = SubgoalDiscovery(settings_of(min_positive=3))
        discovery.add(*on_a_line(0, 5, 20))
        discovery.add(*on_a_line(0, 5, 20))
        assert discovery.search() is None
        discovery.add(*on_a_line(0, 5, 20))
        assert found(discovery) == [5.0]

    def test_the_filter_leaves_nothing(self) -> None:
        discovery = SubgoalDiscovery(settings_of(start_radius=100.0))
        for _ in range(3):
            discovery.add(*on_a_line(0, 5, 20))
            discovery.add(*on_a_line(0, 5, 20, success=False))
            assert discovery.search() is None

    @pytest.mark.parametrize("search", SEARCHES)
    def test_duplicates(self, search: str) -> None:
        discovery = SubgoalDiscovery(settings_of(search=search))
        for _ in range(10):
            discovery.add(*on_a_line(0, 5, 5, 5, 20, 5, 20))
        assert found(discovery) == pytest.approx([5.0], abs=1e-6)

    @pytest.mark.parametrize("search", SEARCHES)
    def test_a_single_instance(self, search: str) -> None:
        discovery = SubgoalDiscovery(settings_of(search=search, negative_bags=False))
        discovery.add(*on_a_line(0, 5, 20))
        assert found(discovery) == pytest.approx([5.0], abs=1e-6)
        assert discovery.search() is None

    @pytest.mark.parametrize("search", SEARCHES)
    def test_one_place_in_positive_and_negative_bags(self, search: str) -> None:
        discovery = SubgoalDiscovery(settings_of(search=search))
        for success in (True, False):
            discovery.add(*on_a_line(0, 5, 20, success=success))
        for _ in range(3):
            subgoal = found(discovery)
            assert subgoal is None or subgoal == pytest.approx([5.0], abs=1e-6)

    def test_a_trajectory_of_one_observation(self) -> None:
        discovery = SubgoalDiscovery(settings_of())
        discovery.add(*on_a_line(0))
        discovery.add(*on_a_line(3, 3, 3))
        assert discovery.search() is None


class TestAdd:
    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_features_that_are_not_finite(self, bad: float) -> None:
        discovery = SubgoalDiscovery(settings_of())
        trajectory, features = on_a_line(0, 5, 20)
        features = features.copy()
        features[1] = bad
        with pytest.raises(ValueError, match=r"^a trajectory has features, or observations, that are NaN or infinite$"):
            discovery.add(trajectory, features)
        assert len(discovery.database) == 0
        discovery.add(*on_a_line(0, 5, 20))
        assert found(discovery) == [5.0]

    @pytest.mark.parametrize("shape", [(3,), (2, 1), (4, 1), (3, 1, 1), ()])
    def test_features_that_do_not_fit(self, shape: tuple[int, ...]) -> None:
        message = (
            r"^features must have shape \(m, d\), one row for each of the trajectory's 3 distinct observations, got "
        )
        with pytest.raises(ValueError, match=message):
            SubgoalDiscovery().add(on_a_line(0, 5, 20)[0], np.zeros(shape))

    def test_label_and_features(self) -> None:
        trajectory, features = on_a_line(0, 5, 20)
        labelled = SubgoalDiscovery().add(trajectory, features.astype(np.float32))
        assert labelled.trajectory is trajectory
        assert labelled.success is True
        assert labelled.features.dtype == np.float64


class TestScale:
    features = np.array([[0.0, 5.0, -1.0], [4.0, 5.0, 1.0], [2.0, 5.0, 0.0]])

    @pytest.mark.parametrize(
        ("kind", "expected"),
        [
            ("given", [1, 1, 1]),
            ("environment", [1, 1, 1]),
            (None, [1, 1, 1]),
            ("categorical", [CATEGORICAL_SCALE] * 3),
            ("identity", [5, 1, 10]),  # 20 units along the range; nothing to go by where nothing changes
        ],
    )
    def test_default(self, kind: str | None, expected: list[float]) -> None:
        assert default_scale(kind, self.features).tolist() == expected

    def test_given(self) -> None:
        discovery = SubgoalDiscovery(settings_of(scale=3.0), kind="identity")
        discovery.add(*on_a_line(0, 5, 20))
        assert discovery.bags() is not None
        assert discovery.scale is not None
        assert discovery.scale.tolist() == [3.0]

    def test_categorical_concepts_are_searched_exhaustively(self) -> None:
        discovery = SubgoalDiscovery(DiscoverySettings(search="gradient"), kind="categorical")
        assert discovery.engine().method == "exhaustive"
        assert SubgoalDiscovery(DiscoverySettings(search="gradient"), kind="identity").engine().method == "gradient"
        for search in SEARCHES:
            assert (
                SubgoalDiscovery(DiscoverySettings(search=search), kind="categorical").engine().method == "exhaustive"
            )

    def test_categorical_states_are_equal_or_far_apart(self) -> None:
        """One-hot features of a Discrete space: the state that both walks share is found."""
        discovery = SubgoalDiscovery(settings_of(min_positive=1, start_radius=1.0, goal_radius=1.0), kind="categorical")
        for path in ([0, 1, 7, 5, 8, 2, 9], [3, 4, 6, 5, 1, 2, 9]):
            discovery.add(trajectory_of(path, is_success=True), np.eye(10)[path])
        subgoal = discovery.search()
        assert subgoal is not None
        assert subgoal.points.argmax() == 5
        assert subgoal.contains(np.eye(10)).tolist() == [i == 5 for i in range(10)]


WHOLE = r"should be (greater than or equal to 1|a valid integer|a finite number)"
RANGES: list[tuple[str, tuple[Any, ...], str]] = [
    *((name, (0, -1, 2.5, math.nan), WHOLE) for name in ("capacity", "min_positive", "max_places", "max_segment")),
    *(
        (name, (-0.1, math.nan), "should be greater than or equal to 0")
        for name in (
            "start_radius",
            "goal_radius",
            "peak_radius",
            "peak_tolerance",
            "max_extent",
            "subgoal_radius",
            "spacing",
        )
    ),
    ("cut_threshold", (1.0, -0.1, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("search_growth", (-0.1, 1.0, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("scale", (0.0, -1.0, math.nan, math.inf), "should be (greater than 0|a finite number)"),
    ("negative_strength", (0.0, -0.5, 1.5, math.nan), "should be (greater than 0|less than or equal to 1)"),
    ("leak", (-0.1, 1.0, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("search", ("random", None), "should be 'gradient', 'exhaustive' or 'incremental'"),
    ("max_bytes", (0, -1), "should be greater than or equal to 1"),
    ("max_share", (0.0, -0.1, 1.1, math.nan), "should be (greater than 0|less than or equal to 1)"),
    ("method", ("hand", None), "should be 'diverse-density', 'em-dd', 'first-visits',"),
    ("segmentation", ("lives", None), "should be 'episodes' or 'peaks'"),
    ("peak_reward", (math.nan, math.inf), "should be a finite number"),
    ("min_cut", (-0.1, 0.5, math.nan), "should be (greater than or equal to 0|less than 0.5)"),
    ("min_passing", (-0.1, 1.0, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("min_contrast", (-1.1, 1.0, math.nan), "should be (greater than or equal to -1|less than 1)"),
    ("salient_share", (-0.1, 1.0, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("loops", ("cut", 1), "should be 'erase' or 'keep'"),
    ("decay", (0.0, 1.0, -0.1, math.nan), "should be (greater than 0|less than 1)"),
    ("threshold", (1.0, -0.1, math.nan), "should be (greater than or equal to 0|less than 1)"),
]


@pytest.mark.parametrize(("name", "values", "message"), RANGES)
def test_settings_out_of_range(name: str, values: tuple[Any, ...], message: str) -> None:
    for value in values:
        with pytest.raises(ValueError, match=rf"^DiscoverySettings: {name} {message}.*, got {value!r}$"):
            DiscoverySettings(**{name: value})


def test_every_setting_has_a_range() -> None:
    """A new field needs a row above."""
    switches = {"negative_bags", "equal_time"}
    assert {f.name for f in dataclasses.fields(DiscoverySettings)} == {name for name, *_ in RANGES} | switches


def test_passing_share_counts_the_successes_whose_way_leads_through() -> None:
    discovery = SubgoalDiscovery(settings_of(loops="erase", subgoal_radius=0.5))
    near = Region(np.array([[3.0]]), np.ones(1), 0.5)
    assert discovery.passing_share(near) == 0.0
    discovery.add(*on_a_line(0, 1, 2, 3, 4))
    discovery.add(*on_a_line(0, 1, 2, 1, 5))
    discovery.add(*on_a_line(0, 1, 3, 1, 4))  # 3 lies on a loop
    discovery.add(*on_a_line(0, 3, success=False))
    assert discovery.passing_share(near) == pytest.approx(1 / 3)
