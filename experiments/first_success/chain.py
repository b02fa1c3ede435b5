"""A chain of rooms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from sb3_options.envs import GridWorld

SIDE = 5
"""Inner side of a room, in cells."""


@dataclass(frozen=True)
class Chain:
    """Rooms of 5 × 5 cells in a row, with a doorway in every wall between two, in turn below and above the middle.

    Attributes:
        n_rooms: How many.
        max_steps: Steps after which an episode ends.
    """

    n_rooms: int = 8
    max_steps: int = 250

    def task(self, rooms: int, max_steps: int | None = None) -> gym.Env[Any, Any]:
        """The same map with the goal at the far end of one of its rooms; episodes start anywhere in the first."""
        return GridWorld(map=self.map(), goal=self.goal(rooms), max_steps=max_steps or self.max_steps)

    def goal(self, rooms: int) -> tuple[int, int]:
        """The last cell of the middle row of a room, counted from 1."""
        return (SIDE + 1) * rooms - 2, SIDE // 2

    def map(self) -> str:
        """As `GridWorld` takes it."""
        width = (SIDE + 1) * self.n_rooms - 1
        rows = [["S" if x < SIDE else "." for x in range(width)] for _ in range(SIDE)]
        for wall in range(1, self.n_rooms):
            x = (SIDE + 1) * wall - 1
            for row in rows:
                row[x] = "#"
            rows[SIDE // 2 + (1 if wall % 2 else -1)][x] = "."
        x, y = self.goal(self.n_rooms)
        rows[y][x] = "G"
        return "\n".join("".join(row) for row in rows)
