"""Maps drawn at random: rooms in a row, or two by two, joined by doorways."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SIDES = (4, 9)
"""Least and largest inner side of a room, in cells."""

SHAPES = ((1, 2), (1, 3), (2, 2))
"""Rows and columns of rooms."""


def random_map(seed: int, *, shapes: Sequence[tuple[int, int]] = SHAPES, sides: tuple[int, int] = SIDES) -> str:
    """A map of some rows and columns of rooms: by default two or three in a row, or two by two.

    Rows and columns of rooms have random sides; every wall between two rooms has one doorway, at a random place, so
    that two by two rooms have two ways. Episodes start anywhere in the first room; the goal is a random cell of the
    last one.

    Args:
        seed: One seed, one map.
        shapes: One of these is drawn: rows and columns of rooms.
        sides: Least and largest inner side of a room, in cells.
    """
    rng = np.random.default_rng(seed)
    n_rows, n_columns = shapes[int(rng.integers(len(shapes)))]
    heights, widths = (rng.integers(sides[0], sides[1] + 1, n) for n in (n_rows, n_columns))
    tops, lefts = (np.concatenate([[0], np.cumsum(sides + 1)]) for sides in (heights, widths))
    cells = np.full((tops[-1] - 1, lefts[-1] - 1), ".")
    cells[tops[1:-1] - 1, :] = "#"
    cells[:, lefts[1:-1] - 1] = "#"
    for row in range(n_rows):
        for column in range(n_columns):
            y, x = tops[row] + rng.integers(heights[row]), lefts[column] + rng.integers(widths[column])
            if column + 1 < n_columns:
                cells[y, lefts[column + 1] - 1] = "."
            if row + 1 < n_rows:
                cells[tops[row + 1] - 1, x] = "."
    cells[: heights[0], : widths[0]] = "S"
    cells[tops[-2] + rng.integers(heights[-1]), lefts[-2] + rng.integers(widths[-1])] = "G"
    return "\n".join("".join(line) for line in cells)
