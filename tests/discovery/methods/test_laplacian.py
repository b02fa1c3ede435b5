"""The graph of places, its eigenvectors, and the methods that use them."""

import copy
from collections.abc import Callable
from functools import partial

import networkx as nx
import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.spatial.distance import pdist

from experiments.random_walks.conditions import run, world_for
from sb3_options.discovery.methods import GivenPlaces, IntrinsicReward, Passage
from sb3_options.discovery.methods.covering import CoveringOptions, farthest_pairs
from sb3_options.discovery.methods.eigenoptions import Eigenoptions
from sb3_options.discovery.methods.method import DiscoveryMethod, Experience
from sb3_options.discovery.methods.place_graph import PlaceGraph, smoothest
from sb3_options.options.proposals import goal_of
from sb3_options.state import restore, state_of
from tests.discovery.methods.test_methods import dumbbell, experience


def graph_of(*ways: list[int], max_places: int = 100) -> PlaceGraph:
    graph = PlaceGraph(max_places)
    for way in ways:
        graph.add(experience(way))
    return graph


def path(n: int) -> csr_array:
    return csr_array(nx.to_scipy_sparse_array(nx.path_graph(n), dtype=float))


class TestPlaceGraph:
    def test_keeps_no_trajectory_alive(self) -> None:
        assert all(point.base is None for point in graph_of([0, 1, 2], [1, 3])._points)

    def test_it_joins_what_follows_each_other(self) -> None:
        part = graph_of([0, 1, 1, 2], [2, 1, 3]).largest_component()
        assert part.points.ravel().tolist() == [0, 1, 2, 3]
        assert part.adjacency.toarray().tolist() == [[0, 1, 0, 0], [1, 0, 1, 1], [0, 1, 0, 0], [0, 1, 0, 0]]

    def test_the_largest_part(self) -> None:
        part = graph_of([0, 1], [5, 6, 7]).largest_component()
        assert part.points.ravel().tolist() == [5, 6, 7]

    def test_no_more_places_than_there_may_be(self) -> None:
        graph = graph_of([0, 1, 2, 3, 4, 1, 0], max_places=3)
        assert len(graph) == 3
        assert graph.largest_component().adjacency.toarray().sum() == 4

    def test_a_state_may_be_a_subgoal_or_not_by_the_last_word(self) -> None:
        graph = graph_of([0, 1])
        graph.add(experience([0, 1], allowed=np.array([True, False])))
        assert graph.largest_component().allowed.tolist() == [True, False]

    def test_its_state(self) -> None:
        graph, other = graph_of([0, 1, 2], [7, 8]), PlaceGraph(100)
        other.set_state(graph.get_state())
        for each in (graph, other):
            each.add(experience([2, 9, 0]))
        one, two = graph.largest_component(), other.largest_component()
        np.testing.assert_array_equal(one.points, two.points)
        np.testing.assert_array_equal(one.adjacency.toarray(), two.adjacency.toarray())


class TestSmoothest:
    @pytest.mark.parametrize("n", [5, 40, 400])
    def test_those_of_a_path_are_cosines(self, n: int) -> None:
        vectors = smoothest(path(n), 3)
        assert vectors.shape == (n, 3)
        for k, vector in enumerate(vectors.T, 1):
            cosine = np.cos(np.pi * k * (np.arange(n) + 0.5) / n)
            assert abs(vector @ cosine) / np.linalg.norm(cosine) == pytest.approx(1.0, abs=1e-6)
            assert vector[np.abs(vector).argmax()] > 0

    def test_many_places_give_the_same_each_time(self) -> None:
        first, second = (smoothest(path(500), 4) for _ in range(2))
        np.testing.assert_array_equal(first, second)

    def test_no_more_than_there_are(self) -> None:
        assert smoothest(path(3), 9).shape == (3, 2)


class TestEigenoptions:
    def test_each_vector_makes_an_option_for_either_end(self) -> None:
        method = Eigenoptions(n_vectors=1, min_trajectories=2)
        assert method.update(experience(list(range(9)))) == []
        one, other = method.update(experience(list(range(9))))
        assert isinstance(one, IntrinsicReward)
        assert isinstance(other, IntrinsicReward)
        assert {float(one.summit.points[0, 0]), float(other.summit.points[0, 0])} == {0.0, 8.0}
        np.testing.assert_allclose(one.potentials, 1.0 - other.potentials)
        assert np.ptp(one.potentials) == pytest.approx(1.0)

    def test_an_end_that_may_be_no_subgoal_is_left_out(self) -> None:
        method = Eigenoptions(n_vectors=1, min_trajectories=1)
        (only,) = method.update(experience(list(range(9)), allowed=np.arange(9) > 0))
        assert isinstance(only, IntrinsicReward)
        assert only.summit.points[0, 0] == 8.0

    def test_four_rooms_four_options_four_corners(self) -> None:
        """The first four of random walks lead to as many rooms, but for that of the goal, which is filtered out."""
        found = run("FourRooms", {"method": "eigenoptions"}, seed=1, n_episodes=16)["found"]
        world = world_for("FourRooms", 1)
        middle = np.array(world.walls.shape)[::-1] // 2
        rooms = {tuple((np.array(each["point"]) > middle).tolist()) for each in found}
        assert len(found) == 4
        assert len(rooms) >= 3


class TestCovering:
    def test_the_ends_of_a_path_are_joined_first(self) -> None:
        first, second = farthest_pairs(path(10), 2)
        assert set(first) == {0, 9}
        assert set(second) != {0, 9}

    def test_pairs_are_of_places_that_options_may_lead_to(self) -> None:
        """What gets no option is not joined, so that the next pair is that of the graph that there is."""
        allowed = np.ones(10, dtype=np.bool_)
        allowed[[0, 9]] = False
        assert set(farthest_pairs(path(10), 1, allowed)[0]) == {1, 8}

    def test_it_raises_the_second_eigenvalue_more_than_other_edges(self) -> None:
        graph = nx.barbell_graph(6, 2)
        before = nx.algebraic_connectivity(graph)
        ((one, other),) = farthest_pairs(csr_array(nx.to_scipy_sparse_array(graph, dtype=float)), 1)
        gains = []
        for pair in [(one, other), *nx.non_edges(graph)]:
            more = graph.copy()
            more.add_edge(*pair)
            gains.append(nx.algebraic_connectivity(more) - before)
        assert gains[0] >= max(gains) - 1e-6

    def test_passages_from_everywhere_to_either_end(self) -> None:
        method = CoveringOptions(n_pairs=1, min_trajectories=1)
        proposals = method.update(experience(list(range(9))))
        assert {float(p.subgoal.points[0, 0]) for p in proposals if isinstance(p, Passage)} == {0.0, 8.0}
        for passage in proposals:
            assert isinstance(passage, Passage)
            assert passage.initiation.contains(np.array([[0.0], [3.7], [1e9]])).all()

    def test_a_pair_stays_joined_once_an_option_leads_to_one_of_its_ends(self) -> None:
        """Or the next end would be the nearest place that the filters leave beside that option."""
        method = CoveringOptions(n_pairs=2, min_trajectories=1)
        lived = experience(list(range(21)))
        first = method.update(lived)[0]
        assert isinstance(first, Passage)
        there = float(first.subgoal.points[0, 0])
        allowed = np.abs(np.arange(21) - there) > 3
        later = method.update(experience(list(range(21)), allowed=allowed, taken=[first.subgoal]))
        ends = [_end(proposal) for proposal in later]
        assert ends[:2] == [there, 20 - there], "the other end of the pair comes first"
        assert all(5 <= end <= 15 for end in ends[2:]), "then what is far from both ends of the ring"

    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_options_of_random_walks_lead_apart(self, seed: int) -> None:
        found = run("FourRooms", {"method": "covering", "max_share": None}, seed=seed, n_episodes=40)["found"]
        assert len(found) == 4
        assert pdist(np.array([each["point"] for each in found])).min() >= 6.0


@pytest.mark.parametrize("make", [Eigenoptions, CoveringOptions])
class TestBoth:
    def test_a_state_goes_on(self, make: Callable[..., DiscoveryMethod], rng: np.random.Generator) -> None:
        method, other = make(min_trajectories=3), make(min_trajectories=3)
        lived = [dumbbell(rng) for _ in range(5)]
        for each in lived[:3]:
            method.update(each)
        restore(other, copy.deepcopy(state_of(method)))
        for each in lived[3:]:
            ends = [[_end(p) for p in one.update(each)] for one in (method, other)]
            assert ends[0] == ends[1]
            assert ends[0]

    def test_arguments(self, make: Callable[..., DiscoveryMethod]) -> None:
        with pytest.raises(ValueError, match=r"^min_trajectories must be a whole number of at least 1, got 0.$"):
            make(min_trajectories=0)

    def test_time_grows_with_the_graph(self, make: Callable[..., DiscoveryMethod]) -> None:
        method = make(min_trajectories=1)
        seconds = []
        for n in (10, 100, 280):
            lived = experience(list(range(n)))
            method.update(lived)
            seconds.append(method.seconds(lived))  # type: ignore[attr-defined]
        assert seconds == sorted(seconds)
        assert seconds[0] < seconds[-1]


def _end(proposal: object) -> float:
    region = proposal.subgoal if isinstance(proposal, Passage) else proposal.summit  # type: ignore[attr-defined]
    return float(region.points[0, 0])


class TestGivenPlaces:
    def test_those_that_the_trajectory_came_to(self) -> None:
        method = GivenPlaces([[5.0], [3.0], [77.0]])
        assert [float(goal_of(p).points[0, 0]) for p in method.update(experience([1, 2, 3, 4, 5]))] == [5.0, 3.0]
        assert method.update(experience([1, 2])) == []

    @pytest.mark.parametrize("points", [[1.0, 2.0], [[np.nan]], np.zeros((0, 2)), [["a"]], [[1.0], [1.0, 2.0]]])
    def test_arguments(self, points: object) -> None:
        with pytest.raises(ValueError, match=r"^points must be .*of shape \(n, d\), n ≥ 1, got"):
            GivenPlaces(points)  # type: ignore[arg-type]


def test_only_a_component_with_three_places_says_anything() -> None:
    for make in (partial(Eigenoptions, min_trajectories=1), partial(CoveringOptions, min_trajectories=1)):
        lived: Experience = experience([0, 1, 0])
        assert make().update(lived) == []


def test_nor_do_many_that_no_step_joins() -> None:
    """Beyond ``max_places`` the ways between places are unknown."""
    for make in (partial(Eigenoptions, min_trajectories=1), partial(CoveringOptions, min_trajectories=1)):
        method = make(max_places=3)
        method._graph._points, method._graph._allowed = [np.array([float(i)]) for i in range(3)], [True] * 3
        assert method.update(experience([7, 8, 9])) == []
