from typing import Any

import pytest

from sb3_options.envs import FOUR_ROOMS, KEY_DOOR, TWO_ROOMS, Direction
from sb3_options.envs.gridworld.grid_map import Cell, GridMap


@pytest.mark.parametrize(
    ("text", "direction", "expected"),
    [
        # States  0 # 2
        #         3 4 5
        ("S#.\n..G", Direction.UP, {0: 0, 2: 2, 3: 0, 4: 4, 5: 2}),
        ("S#.\n..G", Direction.DOWN, {0: 3, 2: 5, 3: 3, 4: 4, 5: 5}),
        ("S#.\n..G", Direction.LEFT, {0: 0, 2: 2, 3: 3, 4: 3, 5: 4}),
        ("S#.\n..G", Direction.RIGHT, {0: 0, 2: 2, 3: 4, 4: 5, 5: 5}),
        # States 0..4 without the key, 5..9 with it. Without it nobody stands on the key; 3 is the door.
        ("SK.DG", Direction.UP, {0: 0, 2: 2, 5: 5, 6: 6, 7: 7, 8: 8, 9: 9}),
        ("SK.DG", Direction.LEFT, {0: 0, 2: 6, 5: 5, 6: 5, 7: 6, 8: 7, 9: 8}),
        ("SK.DG", Direction.RIGHT, {0: 6, 2: 2, 5: 6, 6: 7, 7: 8, 8: 9, 9: 9}),
    ],
)
def test_successors(text: str, direction: Direction, expected: dict[int, int]) -> None:
    successor = GridMap.parse(text).successors[direction]
    assert {state: successor[state] for state in expected} == expected


def test_parse_reads_the_marks() -> None:
    grid = GridMap.parse("""
        S.#.
        KSDG
    """)
    assert (grid.width, grid.height, grid.n_cells, grid.n_states) == (4, 2, 8, 16)
    assert grid.walls.tolist() == [[False, False, True, False], [False] * 4]
    assert (grid.goal, set(grid.keys), set(grid.doors)) == ((3, 1), {(0, 1)}, {(2, 1)})
    assert grid.starts == ((0, 0), (1, 1))


def test_arguments_replace_the_marks() -> None:
    grid = GridMap.parse("SG.", goal=(2, 0), starts=[(1, 0)])
    assert (grid.goal, grid.starts) == ((2, 0), ((1, 0),))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (TWO_ROOMS, [(10, 5)]),
        (FOUR_ROOMS, [(6, 3), (2, 6), (9, 7), (6, 10)]),
        (KEY_DOOR, [(6, 3)]),
        ("S.#.G\n.....\n..#..", [(2, 1)]),
        ("S..\n...\n..G", []),
    ],
)
def test_doorways(text: str, expected: list[Cell]) -> None:
    assert list(GridMap.parse(text).doorways) == expected


@pytest.mark.parametrize(
    ("text", "kwargs", "error", "message"),
    [
        (7, {}, TypeError, r"map must be a string with one line a row, got int"),
        ("", {}, ValueError, r"map is empty: give it at least a start 'S' and a goal 'G'"),
        ("SG\n...", {}, ValueError, r"rows must be equally long, got 3 characters in row 1 and 2 in row 0"),
        ("SG\nx.", {}, ValueError, r"unknown character 'x' in row 1: use # wall, \. floor, S start"),
        ("S.", {}, ValueError, r"exactly one goal 'G', got 0: \[\]; mark one cell, or pass goal=\(x, y\)"),
        (".G", {}, ValueError, r"map has no start 'S' and starts names none: mark cells, or pass starts="),
        ("SKG", {}, ValueError, r"map has a 'K' but no 'D': keys and doors need each other"),
        ("S#.", {"goal": (1, 0)}, ValueError, r"goal \(1, 0\) is a wall: choose a floor cell"),
        ("S#.", {"goal": (3, 0)}, ValueError, r"goal \(3, 0\) is outside the map: x must be in 0\.\.2 and y"),
        ("SKD", {"goal": (1, 0)}, ValueError, r"goal \(1, 0\) is a key: choose a floor cell"),
        ("SG", {"goal": 3}, TypeError, r"goal must be a cell \(x, y\) of two integers, got 3"),
        ("SG", {"starts": 3}, TypeError, r"starts must be a sequence of cells \(x, y\), got 3"),
        ("S.G", {"starts": [(2, 0)]}, ValueError, r"starts\[0\] \(2, 0\) is the goal: choose another cell"),
        ("S.#G", {}, ValueError, r"starts\[0\] \(0, 0\) cannot reach the goal \(3, 0\): open the walls"),
    ],
)
def test_bad_maps(text: Any, kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        GridMap.parse(text, **kwargs)


def test_door_counts_as_passable_for_who_can_get_the_key() -> None:
    assert GridMap.parse("KSDG").starts == ((1, 0),)
