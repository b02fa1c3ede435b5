import numpy as np
import pytest

from sb3_options.envs.gridworld import maps
from sb3_options.envs.gridworld.grid_map import GridMap


def random_walk_success(grid: GridMap, n_steps: int) -> float:
    """Exact probability that a uniformly random walk from a random start reaches the goal in time."""
    transitions = np.zeros((grid.n_states, grid.n_states))
    for successor in grid.successors:
        transitions[np.arange(grid.n_states), successor] += 1 / len(grid.successors)
    goals = [state for state in range(grid.n_states) if grid.cell(state) == grid.goal]
    transitions[goals] = 0
    transitions[goals, goals] = 1
    arrival = np.linalg.matrix_power(transitions, n_steps)[:, goals].sum(axis=1)
    return float(np.mean([arrival[grid.state(cell)] for cell in grid.starts]))


@pytest.mark.parametrize(
    ("text", "max_steps", "within_limit", "median"),
    [
        (maps.TWO_ROOMS, maps.TWO_ROOMS_MAX_STEPS, 0.916, 1_964),
        (maps.FOUR_ROOMS, maps.FOUR_ROOMS_MAX_STEPS, 0.946, 843),
        (maps.KEY_DOOR, maps.KEY_DOOR_MAX_STEPS, 0.929, 1_096),
    ],
)
def test_documented_chances_of_a_random_walk(text: str, max_steps: int, within_limit: float, median: int) -> None:
    grid = GridMap.parse(text)
    assert random_walk_success(grid, max_steps) == pytest.approx(within_limit, abs=5e-4)
    assert random_walk_success(grid, median - 1) < 0.5 <= random_walk_success(grid, median)


def test_two_rooms_is_the_gridworld_of_the_paper() -> None:
    grid = GridMap.parse(maps.TWO_ROOMS)
    assert (grid.width, grid.height) == (21, 10)
    assert grid.starts == tuple((x, y) for y in range(10) for x in range(10))
    assert grid.goal == (20, 9)
    wall = [(int(x), int(y)) for y, x in np.argwhere(grid.walls)]
    assert wall == [(10, y) for y in range(10) if y != 5]


def test_four_rooms_starts_in_the_upper_left_room() -> None:
    grid = GridMap.parse(maps.FOUR_ROOMS)
    assert (grid.width, grid.height) == (13, 13)
    assert grid.starts == tuple((x, y) for y in range(1, 6) for x in range(1, 6))
    assert int((~grid.walls).sum()) == 104  # four rooms of 25, 30, 25 and 20 cells, four hallways


def test_key_door_starts_without_the_key() -> None:
    grid = GridMap.parse(maps.KEY_DOOR)
    assert (grid.width, grid.height, set(grid.keys), set(grid.doors)) == (13, 8, {(0, 7)}, {(6, 3)})
    assert set(grid.starts) == {(x, y) for y in range(8) for x in range(6)} - {(0, 7)}
