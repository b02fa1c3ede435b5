import numpy as np

from sb3_options.envs.gridworld import maps
from sb3_options.envs.gridworld.grid_map import GridMap


def test_two_rooms_is_the_gridworld_of_the_paper() -> None:
    grid = GridMap.parse(maps.TWO_ROOMS)
    assert (grid.width, grid.height) == (21, 10)
    assert grid.starts == tuple((x, y) for y in range(10) for x in range(10))
    assert grid.goal == (20, 9)
    wall = [(int(x), int(y)) for y, x in np.argwhere(grid.walls)]
    assert wall == [(10, y) for y in range(10) if y != 5]
