"""Computes MiniGrid's observations several times faster than MiniGrid itself, with equal results.

MiniGrid spends most of a step copying the cells in view into a new grid, and again for every quarter turn.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

# Object, colour and state of a cell, numbered as in ``minigrid.core.constants``.
WALL_CODE = b"\x02\x05\x00"
EMPTY_CODE = b"\x01\x00\x00"
UNSEEN_CODE = b"\x00\x00\x00"


def see_quickly(env: Any) -> None:
    """Let a MiniGrid environment compute its observations with `image_of`.

    An environment with its own ``gen_obs`` or ``gen_obs_grid`` stays unchanged.
    """
    from minigrid.minigrid_env import MiniGridEnv

    kept = (getattr(type(env), name, None) is getattr(MiniGridEnv, name) for name in ("gen_obs", "gen_obs_grid"))
    if all(kept):
        env.gen_obs = partial(_observation, env)  # a method under another name could not be pickled


def _observation(env: Any) -> dict[str, Any]:
    return {"image": image_of(env), "direction": env.agent_dir, "mission": env.mission}


def image_of(env: Any) -> npt.NDArray[np.uint8]:
    """Return the agent's view (v, v, 3) of a ``MiniGridEnv``: column, row, and object, colour and state."""
    view = env.agent_view_size
    left, top, _, _ = env.get_view_exts(view)
    width = env.grid.width
    height = env.grid.height
    cells = env.grid.grid
    codes: list[bytes] = []
    transparent: list[bool] = []
    for dx, dy in _turned(env.agent_dir, view):
        x, y = left + dx, top + dy
        if not (0 <= x < width and 0 <= y < height):
            codes.append(WALL_CODE)
            transparent.append(False)
            continue
        thing = cells[y * width + x]
        codes.append(EMPTY_CODE if thing is None else bytes(thing.encode()))
        transparent.append(thing is None or thing.see_behind())
    agent = view // 2 * view + view - 1
    if not env.see_through_walls:
        for cell, seen in enumerate(_visible(transparent, view)):
            if not seen:
                codes[cell] = UNSEEN_CODE
    codes[agent] = EMPTY_CODE if env.carrying is None else bytes(env.carrying.encode())
    return np.frombuffer(bytearray(b"".join(codes)), dtype=np.uint8).reshape(view, view, 3)


@lru_cache
def _turned(direction: int, view: int) -> tuple[tuple[int, int], ...]:
    """Return for each cell of the image, column by column, its offset from the view's upper left corner."""
    square = np.stack(np.meshgrid(np.arange(view), np.arange(view), indexing="ij"), axis=-1)
    for _ in range(direction + 1):
        square = np.rot90(square, -1)
    return tuple((int(dx), int(dy)) for dx, dy in square.reshape(-1, 2))


def _visible(transparent: list[bool], view: int) -> list[bool]:
    """Return which cells the agent sees, column by column as ``transparent``. Light spreads from the nearest row."""
    visible = [False] * (view * view)
    row = 1 << view // 2
    for j in reversed(range(view)):
        clear = sum(1 << i for i in range(view) if transparent[i * view + j])
        lit, row = _spread(row, clear, view)
        for i in range(view):
            visible[i * view + j] = bool(lit >> i & 1)
    return visible


@lru_cache(maxsize=1 << 16)
def _spread(lit: int, clear: int, view: int) -> tuple[int, int]:
    """Spread light in a row to the right, then to the left, while cells are clear. Return this row and the next.

    Bit i of ``lit`` and ``clear`` is column i.
    """
    beyond = 0
    for columns, step in ((range(view - 1), 1), (range(view - 1, 0, -1), -1)):
        for i in columns:
            if lit >> i & 1 and clear >> i & 1:
                lit |= 1 << i + step
                beyond |= 1 << i + step | 1 << i
    return lit, beyond
