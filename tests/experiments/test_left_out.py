"""Methods on graphs, entrants of the race that the library leaves out."""

import networkx as nx
import numpy as np
import pytest

from experiments.methods.left_out import Betweenness, normalised_cut, weights_of
from experiments.random_walks.conditions import is_bottleneck, run, world_for


def test_weights_count_transitions_both_ways() -> None:
    weights = weights_of(np.array([0, 1, 0, 0, 2]), 3)
    assert weights.tolist() == [[0, 2, 1], [2, 0, 0], [1, 0, 0]]


def test_the_cut_is_the_best_along_the_eigenvector() -> None:
    graph = nx.barbell_graph(5, 0)
    cut, part = normalised_cut(nx.to_numpy_array(graph))
    assert len(set(part[:5])) == len(set(part[5:])) == 1
    assert part[0] != part[9]
    first = set(np.flatnonzero(part == part[0]).tolist())
    expected = nx.normalized_cut_size(graph, first)
    assert cut == pytest.approx(expected)


def test_local_maxima_of_betweenness() -> None:
    """A path has one in the middle; in a ring all tie."""
    assert Betweenness().candidates(np.array([0, 1, 2, 3, 4, 3, 4, 4]), 5).tolist() == [2]
    assert Betweenness().candidates(np.array([0, 1, 2, 3, 0]), 4).tolist() == []


@pytest.mark.parametrize("name", ["l-cut", "betweenness"])
def test_the_doorway_of_two_rooms_is_found(name: str) -> None:
    found = run("TwoRooms", {"method": name}, seed=0, n_episodes=14)["found"]
    assert len(found) == 1
    assert is_bottleneck(world_for("TwoRooms", 0), found[0]["point"])
