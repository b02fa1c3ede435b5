"""ASCII maps: the meaning of their characters, the moves between cells, and the errors of bad maps."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from operator import index
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int]  # (x, y) = (column, row), counted from the top left corner

WALL, FLOOR, START, GOAL, KEY, DOOR = "#.SGKD"
_CHARACTERS = frozenset((WALL, FLOOR, START, GOAL, KEY, DOOR))


class Direction(IntEnum):
    """The four moves; their values are the actions of a gridworld."""

    UP = 0
    DOWN = 1
    LEFT = 2
    RIGHT = 3


_OFFSETS: dict[Direction, Cell] = {
    Direction.UP: (0, -1),
    Direction.DOWN: (0, 1),
    Direction.LEFT: (-1, 0),
    Direction.RIGHT: (1, 0),
}


@dataclass(frozen=True, eq=False)
class GridMap:
    """A parsed map and its deterministic dynamics.

    A *state* is one integer: ``y * width + x`` without the key, plus the number of cells with the key. Maps without a
    key have only states of the first kind.
    """

    walls: NDArray[np.bool_]  # (height, width), read-only
    goal: Cell
    starts: tuple[Cell, ...]
    keys: frozenset[Cell]  # every key opens all doors, so keys are interchangeable
    doors: frozenset[Cell]  # only an agent with a key can enter them

    @classmethod
    def parse(cls, text: str, goal: Cell | None = None, starts: Sequence[Cell] | None = None) -> Self:
        """Read a map."""
        rows = _rows(text)
        cells = {mark: _cells_of(rows, mark) for mark in _CHARACTERS}
        if bool(cells[KEY]) != bool(cells[DOOR]):
            there, missing = ("D", "K") if cells[DOOR] else ("K", "D")
            raise ValueError(f"map has a {there!r} but no {missing!r}: keys and doors need each other")
        if goal is not None:
            goal = _as_cell(goal, "goal")
        elif len(cells[GOAL]) == 1:
            goal = cells[GOAL][0]
        else:
            raise ValueError(
                f"map must have exactly one goal 'G', got {len(cells[GOAL])}: {cells[GOAL]}; mark one cell, or pass "
                "goal=(x, y)"
            )
        if starts is None:
            # A caller who moves the goal onto one of the map's many starts means to use the other starts.
            starts = [cell for cell in cells[START] if cell != goal]
        elif not isinstance(starts, Iterable):
            raise TypeError(f"starts must be a sequence of cells (x, y), got {starts!r}")
        walls = np.array([[mark == WALL for mark in row] for row in rows])
        walls.flags.writeable = False
        parsed = cls(
            walls=walls,
            goal=goal,
            starts=tuple(_as_cell(cell, f"starts[{i}]") for i, cell in enumerate(starts)),
            keys=frozenset(cells[KEY]),
            doors=frozenset(cells[DOOR]),
        )
        parsed._check_free(goal, "goal", parsed.keys | parsed.doors)
        if not parsed.starts:
            raise ValueError("map has no start 'S' and starts names none: mark cells, or pass starts=[(x, y), ...]")
        for i, cell in enumerate(parsed.starts):
            parsed.start_state(cell, f"starts[{i}]")
        return parsed

    @property
    def height(self) -> int:
        """Number of rows."""
        return len(self.walls)

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.walls[0])

    @property
    def n_cells(self) -> int:
        """Number of cells, walls included."""
        return self.walls.size

    @property
    def n_states(self) -> int:
        """Number of states: the cells, twice if there is a key."""
        return self.n_cells * (2 if self.keys else 1)

    @cached_property
    def doorways(self) -> tuple[Cell, ...]:
        """Cells that are one-cell gaps in a wall, row by row.

        A gap has walls on two opposite sides and none on the other two. In a corridor one cell wide, every cell
        between its ends is a gap. The border counts as a wall, a door does not.
        """
        closed = np.pad(self.walls, 1, constant_values=True)
        up, down, left, right = closed[:-2, 1:-1], closed[2:, 1:-1], closed[1:-1, :-2], closed[1:-1, 2:]
        gaps = ~self.walls & ((up & down & ~left & ~right) | (left & right & ~up & ~down))
        return tuple((int(x), int(y)) for y, x in np.argwhere(gaps))

    @cached_property
    def successors(self) -> tuple[tuple[int, ...], ...]:
        """Next state by direction and state, as ``successors[direction][state]``.

        They are nested tuples, because looking up one Python integer is several times as fast in a tuple as in an
        array.
        """
        return tuple(
            tuple(self._successor(state, direction) for state in range(self.n_states)) for direction in Direction
        )

    @cached_property
    def solvable(self) -> frozenset[int]:
        """The states from which the goal can be reached, including the goal's own."""
        predecessors: list[list[int]] = [[] for _ in range(self.n_states)]
        for successor in self.successors:
            for state, following in enumerate(successor):
                predecessors[following].append(state)
        found = {self.state(self.goal, has_key) for has_key in ([False, True] if self.keys else [False])}
        queue = deque(found)
        while queue:
            for state in predecessors[queue.popleft()]:
                if state not in found and not self.walls.flat[state % self.n_cells]:
                    found.add(state)
                    queue.append(state)
        return frozenset(found)

    def state(self, cell: Cell, has_key: bool = False) -> int:
        """Return the state of an agent that enters a cell: if a key lies there, the agent now holds it."""
        return cell[1] * self.width + cell[0] + self.n_cells * (has_key or cell in self.keys)

    def cell(self, state: int) -> Cell:
        """Return the cell of a state."""
        y, x = divmod(state % self.n_cells, self.width)
        return x, y

    def start_state(self, cell: Cell, argument: str) -> int:
        """Check a start cell, and return the state in which an episode begins there."""
        cell = _as_cell(cell, argument)
        self._check_free(cell, argument, self.doors)
        if cell == self.goal:
            raise ValueError(f"{argument} {cell} is the goal: choose another cell")
        state = self.state(cell)
        if state not in self.solvable:
            raise ValueError(
                f"{argument} {cell} cannot reach the goal {self.goal}: open the walls (or put the key "
                "where the agent can get at it), or choose another cell"
            )
        return state

    def _check_free(self, cell: Cell, argument: str, taken: frozenset[Cell]) -> None:
        x, y = cell
        if not (0 <= x < self.width and 0 <= y < self.height):
            raise ValueError(
                f"{argument} {cell} is outside the map: x must be in 0..{self.width - 1} and y in 0..{self.height - 1}"
            )
        if self.walls[y, x]:
            raise ValueError(f"{argument} {cell} is a wall: choose a floor cell")
        if cell in taken:
            thing = "key" if cell in self.keys else "door"
            raise ValueError(f"{argument} {cell} is a {thing}: choose a floor cell")

    def _successor(self, state: int, direction: Direction) -> int:
        (x, y), (dx, dy) = self.cell(state), _OFFSETS[direction]
        x, y = x + dx, y + dy
        has_key = state >= self.n_cells
        inside = 0 <= x < self.width and 0 <= y < self.height
        if not inside or self.walls[y, x] or ((x, y) in self.doors and not has_key):
            return state
        return self.state((x, y), has_key)


def _rows(text: str) -> list[str]:
    if not isinstance(text, str):
        raise TypeError(f"map must be a string with one line a row, got {type(text).__name__}")
    rows = [line.strip() for line in text.strip().splitlines()]
    if not rows:
        raise ValueError("map is empty: give it at least a start 'S' and a goal 'G'")
    for y, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise ValueError(
                f"map rows must be equally long, got {len(row)} characters in row {y} and {len(rows[0])} in row 0"
            )
        unknown = set(row) - _CHARACTERS
        if unknown:
            raise ValueError(
                f"map has the unknown character {min(unknown)!r} in row {y}: use # wall, . floor, S start, "
                "G goal, K key, D door"
            )
    return rows


def _cells_of(rows: list[str], mark: str) -> list[Cell]:
    return [(x, y) for y, row in enumerate(rows) for x, character in enumerate(row) if character == mark]


def _as_cell(value: Any, argument: str) -> Cell:
    try:
        x, y = value
        return index(x), index(y)
    except (TypeError, ValueError):
        raise TypeError(f"{argument} must be a cell (x, y) of two integers, got {value!r}") from None
