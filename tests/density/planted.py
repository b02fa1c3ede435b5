"""Bags whose concept is known: two rooms with a door, and noise around a place."""

import functools

import numpy as np

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags

START_RADIUS, GOAL_RADIUS, GOAL, DOOR = 2, 5, (20, 0), (10, 5)
MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1))


def two_room_bag(rng: np.random.Generator, drift: float) -> FloatArray:
    """First visits of a walk that steps towards door and goal with probability `drift`, filtered.

    The rooms are 21 × 10 cells, with a wall in column 10. Starts keep so far from the door that the filter does not.
    """
    start = cell = (int(rng.integers(7)), int(rng.integers(10)))
    path = [cell]
    while cell != GOAL:
        aim = DOOR if cell[0] < DOOR[0] else GOAL
        towards = [(int(np.sign(aim[0] - cell[0])), 0), (0, int(np.sign(aim[1] - cell[1])))]
        moves = [m for m in towards if m != (0, 0)] if rng.random() < drift else MOVES
        step = moves[rng.integers(len(moves))]
        new = (cell[0] + step[0], cell[1] + step[1])
        if 0 <= new[0] < 21 and 0 <= new[1] < 10 and (new[0] != DOOR[0] or new == DOOR):
            cell = new
        path.append(cell)

    def apart(a: tuple[int, int], b: tuple[int, int]) -> int:
        return abs(a[0] - b[0]) + abs(a[1] - b[1])

    kept = [c for c in dict.fromkeys(path) if apart(c, start) > START_RADIUS and apart(c, GOAL) > GOAL_RADIUS]
    return np.array(kept, dtype=np.float64)


@functools.cache
def two_rooms(seed: int, drift: float = 0.15) -> Bags:
    rng = np.random.default_rng(seed)
    return Bags.pack([two_room_bag(rng, drift) for _ in range(25)])


def planted(seed: int, n_negative: int = 0) -> Bags:
    """Uniform noise over a square, with one instance a bag around (3, −2)."""
    rng = np.random.default_rng(seed)
    positive = [np.vstack([rng.uniform(-10, 10, size=(20, 2)), rng.normal([3, -2], 0.3)]) for _ in range(15)]
    return Bags.pack(positive, [rng.uniform(-10, 10, size=(20, 2)) for _ in range(n_negative)])
