"""Betweenness of the nodes of a graph (Freeman 1977), from all sources at once."""

from __future__ import annotations

import numpy as np

from sb3_options.experience.observations import FloatArray, IntArray


def betweenness(one: IntArray, other: IntArray, n: int) -> FloatArray:
    """Over all pairs of other nodes, the sum of the shares of their shortest paths that lead through a node, (n,).

    Brandes (2001), *A Faster Algorithm for Betweenness Centrality*: the dependencies of each source add up backwards
    along its shortest paths. All sources take a step at a time, where `networkx` takes one source after the other and
    five to ten times as long.

    Args:
        one: A node of each edge, (m,); each edge once.
        other: Its other node, which is not the same, (m,).
        n: How many nodes there are.
    """
    ends = np.concatenate([one, other])
    neighbours = np.concatenate([other, one])[np.argsort(ends, kind="stable")]
    degrees = np.bincount(ends, minlength=n)
    first = np.cumsum(degrees) - degrees
    # A node as seen from a source is a row, n · node + source.
    paths, known, steps = np.zeros(n * n), np.zeros(n * n, dtype=bool), list[tuple[IntArray, IntArray]]()
    at: IntArray = np.arange(n) * (n + 1)
    paths[at], known[at] = 1.0, True
    while len(at):
        node, source = np.divmod(at, n)
        out = degrees[node]
        which = np.arange(out.sum()) + np.repeat(first[node] - (np.cumsum(out) - out), out)
        near, far = np.repeat(at, out), neighbours[which] * n + np.repeat(source, out)
        new = ~known[far]
        near, far = near[new], far[new]
        np.add.at(paths, far, paths[near])
        known[far] = True
        steps.append((near, far))
        at = np.unique(far)
    dependency = np.zeros(n * n)
    for near, far in reversed(steps):
        np.add.at(dependency, near, paths[near] / paths[far] * (1.0 + dependency[far]))
    through = dependency.reshape(n, n)
    np.fill_diagonal(through, 0.0)
    total: FloatArray = through.sum(axis=1) / 2.0  # each pair was counted from both its ends
    return total
