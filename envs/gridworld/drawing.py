"""Pictures of a gridworld: one flat colour per cell for agents that learn from images, icons for people."""

import numpy as np
from numpy.typing import NDArray

from sb3_options.envs.gridworld.grid_map import Cell, GridMap

RENDER_CELL_PX = 32  # side of a rendered cell, px: a multiple of 16, because video encoders pad other sizes

Colour = tuple[int, int, int]

# RGB, 0..255. The agent's colour occurs nowhere else, so that a picture shows where it is.
AGENT: Colour = (38, 92, 204)
GOAL: Colour = (46, 160, 67)
KEY: Colour = (232, 172, 20)
_WALL: Colour = (52, 58, 70)
_FLOOR: Colour = (246, 244, 238)
_DOOR: Colour = (143, 84, 42)
_OPEN_DOOR: Colour = (222, 196, 170)
_GRID_LINE: Colour = (222, 219, 210)
_START_TINT: Colour = (226, 234, 246)
_GOAL_TINT: Colour = (216, 240, 219)
_WHITE: Colour = (255, 255, 255)

Picture = NDArray[np.uint8]
Mask = NDArray[np.float64]

# Pixel centres of one cell, in cells from its middle.
_V, _U = (np.mgrid[:RENDER_CELL_PX, :RENDER_CELL_PX] + 0.5) / RENDER_CELL_PX - 0.5


def flat_picture(grid: GridMap, has_key: bool, cell_px: int) -> Picture:
    """Draw each cell as a square of one colour, without agent and starts. With the key, doors are open."""
    colours = np.full((grid.height, grid.width, 3), _FLOOR, dtype=np.uint8)
    colours[grid.walls] = _WALL
    for x, y in grid.doors:
        colours[y, x] = _OPEN_DOOR if has_key else _DOOR
    if not has_key:
        for x, y in grid.keys:
            colours[y, x] = KEY
    colours[grid.goal[1], grid.goal[0]] = GOAL
    return colours.repeat(cell_px, axis=0).repeat(cell_px, axis=1)


def fill_cell(picture: Picture, cell: Cell, cell_px: int, colour: Colour) -> None:
    """Fill one cell of a flat picture in place."""
    x, y = cell[0] * cell_px, cell[1] * cell_px
    picture[y : y + cell_px, x : x + cell_px] = colour


def scene(grid: GridMap, has_key: bool) -> Picture:
    """Draw a map for people, without the agent. With the key, doors are open."""
    picture = np.full((grid.height * RENDER_CELL_PX, grid.width * RENDER_CELL_PX, 3), _FLOOR, dtype=np.uint8)
    everywhere = np.ones_like(_U)
    grid_line = _box(0, 0, 0.5, 0.5) - _box(0, 0, 0.5 - 1 / RENDER_CELL_PX, 0.5 - 1 / RENDER_CELL_PX)
    for y, x in np.argwhere(~grid.walls):
        cell = int(x), int(y)
        if cell in grid.starts:
            _blend(picture, cell, everywhere, _START_TINT)
        _blend(picture, cell, grid_line, _GRID_LINE)
    for y, x in np.argwhere(grid.walls):
        _blend(picture, (int(x), int(y)), everywhere, _WALL)
    for cell in grid.doors:
        _draw_door(picture, cell, is_open=has_key)
    if not has_key:
        for cell in grid.keys:
            _draw_key(picture, cell)
    _blend(picture, grid.goal, everywhere, _GOAL_TINT)
    _blend(picture, grid.goal, _disc(0, 0, 0.36) - _disc(0, 0, 0.25) + _disc(0, 0, 0.14), GOAL)
    return picture


def draw_agent(picture: Picture, cell: Cell) -> None:
    """Draw the agent into a scene, in place."""
    _blend(picture, cell, _disc(0, 0, 0.38), _WHITE)
    _blend(picture, cell, _disc(0, 0, 0.32), AGENT)


def _draw_key(picture: Picture, cell: Cell) -> None:
    bow = _disc(-0.17, 0, 0.17) - _disc(-0.17, 0, 0.08)
    blade = _box(0.17, 0, 0.17, 0.04)
    teeth = np.maximum(_box(0.2, 0.09, 0.03, 0.07), _box(0.31, 0.09, 0.03, 0.07))
    _blend(picture, cell, np.maximum.reduce([bow, blade, teeth]), KEY)


def _draw_door(picture: Picture, cell: Cell, is_open: bool) -> None:
    leaf = _box(0, 0, 0.44, 0.44)
    if is_open:
        _blend(picture, cell, leaf - _box(0, 0, 0.36, 0.36), _DOOR)
        return
    _blend(picture, cell, leaf, _DOOR)
    _blend(picture, cell, np.maximum(_disc(0, -0.06, 0.1), _box(0, 0.08, 0.04, 0.12)), KEY)  # the keyhole


def _disc(u: float, v: float, radius: float) -> Mask:
    """Return how much of each pixel of a cell a disc covers, 0..1; centre and radius in cells."""
    return _coverage(radius - np.hypot(_U - u, _V - v))


def _box(u: float, v: float, half_width: float, half_height: float) -> Mask:
    """Return how much of each pixel of a cell an upright box covers, 0..1; centre and half sides in cells."""
    return _coverage(np.minimum(half_width - np.abs(_U - u), half_height - np.abs(_V - v)))


def _coverage(depth: Mask) -> Mask:
    """Turn the depth of pixel centres inside a shape, in cells, into coverage with a soft edge of 1 px."""
    coverage: Mask = np.clip(depth * RENDER_CELL_PX + 0.5, 0, 1)
    return coverage


def _blend(picture: Picture, cell: Cell, mask: Mask, colour: Colour) -> None:
    x, y = cell[0] * RENDER_CELL_PX, cell[1] * RENDER_CELL_PX
    square = picture[y : y + RENDER_CELL_PX, x : x + RENDER_CELL_PX]
    square[:] = np.rint(square + mask[..., None] * (np.array(colour) - square.astype(np.float64)))
