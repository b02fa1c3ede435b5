"""Three kinds of observation of a gridworld, each of which can be converted back to positions."""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_options.envs.gridworld import drawing
from sb3_options.envs.gridworld.grid_map import GridMap

MIN_IMAGE_PX = 36  # smallest side of an image, px, that the convolutions of SB3's NatureCNN accept


class OneHotView:
    """A vector of zeros with a one at the index of the state."""

    def __init__(self, grid: GridMap) -> None:
        self.space = spaces.Box(0.0, 1.0, (grid.n_states,), np.float32)
        self._n_states = grid.n_states
        self._positions = _position_table(grid)

    def observe(self, state: int) -> NDArray[np.float32]:
        """Return the observation of a state, as a new array."""
        observation = np.zeros(self._n_states, np.float32)
        observation[state] = 1
        return observation

    def positions(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Return column, row and, on a map with a key, 0 or 1 for having it: (batch, 2 or 3)."""
        positions: NDArray[np.float64] = self._positions[observations.argmax(axis=1)]
        return positions


class XYView:
    """The position itself, in cells."""

    def __init__(self, grid: GridMap) -> None:
        self._positions = _position_table(grid).astype(np.float32)
        high = np.array([grid.width - 1, grid.height - 1, 1][: self._positions.shape[1]], np.float32)
        self.space = spaces.Box(np.zeros_like(high), high)

    def observe(self, state: int) -> NDArray[np.float32]:
        """Return the observation of a state, as a new array."""
        observation: NDArray[np.float32] = self._positions[state].copy()
        return observation

    def positions(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Return column, row and, on a map with a key, 0 or 1 for having it: (batch, 2 or 3)."""
        return observations.astype(np.float64)


class ImageView:
    """A picture (height, width, RGB) with one colour per cell. A held key is gone, and doors are open."""

    def __init__(self, grid: GridMap) -> None:
        self._grid = grid
        self._cell_px = math.ceil(MIN_IMAGE_PX / min(grid.width, grid.height))
        self._backgrounds = [
            drawing.flat_picture(grid, has_key, self._cell_px) for has_key in ([False, True] if grid.keys else [False])
        ]
        self.space = spaces.Box(0, 255, self._backgrounds[0].shape, np.uint8)

    def observe(self, state: int) -> NDArray[np.uint8]:
        """Return the observation of a state, as a new array."""
        picture = self._backgrounds[state >= self._grid.n_cells].copy()
        drawing.fill_cell(picture, self._grid.cell(state), self._cell_px, drawing.AGENT)
        return picture

    def positions(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Return column, row and, on a map with a key, 0 or 1 for having it: (batch, 2 or 3)."""
        # A cell has one colour, so one of its pixels is enough.
        cells = observations[:, :: self._cell_px, :: self._cell_px]
        is_agent = (cells == drawing.AGENT).all(axis=3)
        seen = is_agent.any(axis=(1, 2))
        if not seen.all():
            raise ValueError(
                f"observations[{int(seen.argmin())}] shows no agent: pass the environment's own images, "
                "neither rescaled nor normalized"
            )
        cell = is_agent.reshape(len(cells), self._grid.n_cells).argmax(axis=1)
        y, x = np.divmod(cell, self._grid.width)
        columns = [x, y]
        if self._grid.keys:
            key_x, key_y = min(self._grid.keys)
            columns.append((cells[:, key_y, key_x] != drawing.KEY).any(axis=1))
        return np.stack(columns, axis=1).astype(np.float64)


View = OneHotView | XYView | ImageView


def _position_table(grid: GridMap) -> NDArray[np.float64]:
    """Return the positions of all states, shape (number of states, 2 or 3)."""
    rows = [(*grid.cell(state), state >= grid.n_cells) for state in range(grid.n_states)]
    return np.array(rows, dtype=np.float64)[:, : 3 if grid.keys else 2]
