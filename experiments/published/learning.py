"""How soon an agent that behaves at random, among moves and options, has learned the way (Machado et al. 2017)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.common.gridworlds import rooms_of
from experiments.published.graphs import GAMMA, N_MOVES
from sb3_options.envs import GridWorld
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray

STEP_SIZE, EPISODE, EVERY, MOST = 0.1, 100, 100, 100_000
"""Step size of Q-learning; steps of an episode, and between two evaluations; most steps in all."""


def moves_of(cells: IntArray) -> IntArray:
    """Where each move leads from each cell (n, 2), (n, 4); one into a wall leads nowhere."""
    number = {tuple(cell): i for i, cell in enumerate(cells.tolist())}
    steps = ((0, 1), (0, -1), (1, 0), (-1, 0))
    return np.array([[number.get((x + dx, y + dy), i) for dx, dy in steps] for i, (x, y) in enumerate(cells.tolist())])


def tasks_of(world: GridWorld, cells: IntArray, n: int, random: np.random.Generator) -> IntArray:
    """Start and goal of ``n`` tasks, (n, 2): cells of two different rooms, drawn uniformly."""
    rooms = rooms_of(world)
    room = np.array([next((i for i, each in enumerate(rooms) if tuple(cell) in each), -1) for cell in cells.tolist()])
    numbers = np.flatnonzero(room >= 0)
    tasks: list[IntArray] = []
    while len(tasks) < n:
        pair = random.choice(numbers, 2)
        tasks += [pair] if room[pair[0]] != room[pair[1]] else []
    return np.array(tasks)


def steps_to_learn(
    moves: IntArray, options: Sequence[IntArray], tasks: IntArray, random: np.random.Generator, most: int = MOST
) -> IntArray:
    """Steps until the greedy policy over single moves leads from start to goal, one number a task, (m,).

    The agent chooses uniformly among the moves and the options that may begin where it is, and follows an option to its
    end. Q-learning learns of each move alone; the reward is 1 at the goal. All tasks at once.

    Args:
        moves: Where each move leads, (n, 4).
        options: Each the next cell from every cell, (n,); where that is the cell itself, it ends.
        tasks: Start and goal of each, (m, 2).
        random: Of the choices.
        most: A task that takes longer counts as much.
    """
    n, everyone, (start, goal) = len(moves), np.arange(len(tasks)), tasks.T
    follow = np.stack([np.arange(n), *options])  # the first is no option: it ends everywhere
    action = np.stack([(moves == each[:, None]).argmax(axis=1) for each in follow])
    may = np.concatenate([np.ones((n, N_MOVES), dtype=bool), (follow[1:] != np.arange(n)).T], axis=1)
    values, learned = np.zeros((len(tasks), n, N_MOVES)), np.full(len(tasks), most)
    at, option, left = start.copy(), np.zeros(len(tasks), dtype=np.int64), np.full(len(tasks), EPISODE)
    for step in range(1, most + 1):
        chosen = np.where(may[at], random.random((len(tasks), may.shape[1])), -1.0).argmax(axis=1)
        free = option == 0
        option = np.where(free, np.maximum(chosen - N_MOVES + 1, 0), option)
        move = np.where(option > 0, action[option, at], chosen)
        led = moves[at, move]
        there = led == goal
        target = there + GAMMA * np.where(there, 0.0, values[everyone, led].max(axis=1))
        values[everyone, at, move] += STEP_SIZE * (target - values[everyone, at, move])
        left -= 1
        over = there | (left == 0)
        option = np.where(over | (follow[option, led] == led), 0, option)
        at, left = np.where(over, start, led), np.where(over, EPISODE, left)
        if step % EVERY == 0:
            learned = np.where((learned == most) & _arrives(values, moves, start, goal), step, learned)
            if (learned < most).all():
                break
    return learned


def _arrives(values: FloatArray, moves: IntArray, start: IntArray, goal: IntArray) -> BoolArray:
    """Whether the greedy policy of each task comes to its goal within an episode, (m,)."""
    at, everyone = start.copy(), np.arange(len(start))
    for _ in range(EPISODE):
        at = np.where(at == goal, at, moves[at, values[everyone, at].argmax(axis=1)])
    arrived: BoolArray = at == goal
    return arrived
