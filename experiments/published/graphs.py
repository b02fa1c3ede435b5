"""Graphs of whole tasks, and random walks on them that may take options."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.linalg import eigh
from scipy.sparse import csr_array

from experiments.common.gridworlds import world_of
from sb3_options.envs import GridWorld
from sb3_options.experience.observations import FloatArray, IntArray

N_MOVES = 4

GAMMA, SWEEPS, NO_GAIN = 0.9, 400, 1e-12
"""Discount of eigenoptions in the paper; sweeps after which values differ by less than rounding; and what that is."""


def grid(env_id: str) -> tuple[GridWorld, IntArray, csr_array]:
    """A gridworld, its free cells (n, 2), and which are neighbours, (n, n)."""
    world = world_of(env_id, observation="xy")
    rows, columns = np.nonzero(~np.asarray(world.walls, dtype=bool))
    cells = np.stack([columns, rows], axis=1)
    near = np.abs(cells[:, None] - cells[None]).sum(axis=2) == 1
    return world, cells, csr_array(near.astype(np.float64))


def taxi_env() -> Any:
    """Taxi itself, of the newest version that there is."""
    return next(gym.make(name).unwrapped for name in ("Taxi-v4", "Taxi-v3") if name in gym.registry)


def taxi() -> tuple[list[tuple[int, int, int, int]], IntArray]:
    """The states of Taxi that are not terminal, as row, column, passenger and destination; transitions between them."""
    env = taxi_env()
    states = [tuple(map(int, env.decode(number))) for number in range(len(env.P))]
    running = [i for i, (_, _, passenger, destination) in enumerate(states) if passenger != destination]
    steps = {
        (number, int(led))
        for number in running
        for outcomes in env.P[number].values()
        for _, led, _, ended in outcomes
        if not ended and led != number
    }
    return states, np.array(sorted(steps))  # type: ignore[return-value]  # of four numbers each


def smoothest(adjacency: csr_array, k: int) -> FloatArray:
    """The k eigenvectors of the Laplacian D − A with the smallest eigenvalues above 0, smallest first, (n, k).

    Their sign, which is arbitrary, is such that the largest entry is positive.
    """
    dense = adjacency.toarray()
    k = min(k, len(dense) - 1)
    _, vectors = eigh(np.diag(dense.sum(axis=1)) - dense, subset_by_index=[1, k])
    largest = np.abs(vectors).argmax(axis=0)
    signed: FloatArray = vectors * np.sign(vectors[largest, np.arange(k)])
    return signed


def farthest_pairs(adjacency: csr_array, n_pairs: int) -> list[tuple[int, int]]:
    """Places with the largest and smallest entry of the Fiedler vector, joined before the next (Jinnai et al. 2019)."""
    pairs: list[tuple[int, int]] = []
    for _ in range(n_pairs):
        fiedler = smoothest(joined(adjacency, pairs), 1)[:, 0]
        pairs.append((int(fiedler.argmax()), int(fiedler.argmin())))
    return pairs


def climbed(adjacency: csr_array, vector: FloatArray) -> IntArray:
    """Where each place leads when r(s, s') = e(s') − e(s) is gained, by value iteration: (n,).

    The place of the path's next step; of a place where nothing is left to gain, itself.
    """
    near, n = adjacency.toarray() > 0, len(vector)
    rewards, values = vector[None, :] - vector[:, None], np.zeros(n)
    for _ in range(SWEEPS):
        gains = np.where(near, rewards + GAMMA * values[None, :], -np.inf)
        values = np.maximum(gains.max(axis=1), 0.0)
    nexts: IntArray = np.where(values > NO_GAIN, gains.argmax(axis=1), np.arange(n))
    return nexts


def diffusion_time(adjacency: csr_array, options: Sequence[IntArray]) -> float:
    """Expected steps between two places, drawn uniformly, of an agent that chooses uniformly (Machado et al. 2017, §5).

    It chooses among four moves, of which those into a wall do nothing, and the options, each of which is followed to
    its end. A goal that an option passes is reached.

    Args:
        adjacency: Of cells, (n, n).
        options: Each the next place from every place, (n,); one that ends where it starts is not chosen there.
    """
    dense = adjacency.toarray()
    n, total = len(dense), 0.0
    moves = dense / N_MOVES + np.diag(1.0 - dense.sum(axis=1) / N_MOVES)
    for goal in range(n):
        chance, steps, count = moves * N_MOVES, np.full(n, float(N_MOVES)), np.full(n, float(N_MOVES))
        for option in options:
            ends, length = np.arange(n), np.zeros(n)
            for _ in range(n):
                on = (option[ends] != ends) & ~((ends == goal) & (length > 0))
                ends, length = np.where(on, option[ends], ends), length + on
            may = length > 0
            chance[np.flatnonzero(may), ends[may]] += 1.0
            steps[may] += length[may]
            count[may] += 1.0
        others = np.arange(n) != goal
        matrix = np.eye(n - 1) - (chance / count[:, None])[np.ix_(others, others)]
        total += float(np.linalg.solve(matrix, (steps / count)[others]).sum())
    return total / (n * (n - 1))


def cover_time(adjacency: csr_array, random: np.random.Generator, n_walks: int) -> float:
    """Mean decisions in which a random walk visits all places; an edge is a decision (Jinnai et al. 2019)."""
    matrix = adjacency.tocsr()
    neighbours = [matrix.indices[matrix.indptr[i] : matrix.indptr[i + 1]] for i in range(matrix.shape[0])]
    total = 0
    for _ in range(n_walks):
        at = int(random.integers(len(neighbours)))
        left = set(range(len(neighbours))) - {at}
        while left:
            at = int(neighbours[at][int(random.random() * len(neighbours[at]))])
            left.discard(at)
            total += 1
    return total / n_walks


def joined(adjacency: csr_array, pairs: Sequence[tuple[int, int]]) -> csr_array:
    """The graph with an edge more for each pair: options both ways."""
    more = adjacency.tolil()
    for one, other in pairs:
        more[one, other] = more[other, one] = 1.0
    return csr_array(more)
