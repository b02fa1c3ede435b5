"""L-cut, an entrant of the race."""

import networkx as nx
import numpy as np
import pytest

from experiments.methods.l_cut import normalised_cut, weights_of


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
