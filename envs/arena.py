"""The Pioneer's arena: four walls, round posts, and where robot, balls and posts may stand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_options.envs.bullet import Box, Post

__all__ = ["BALL_RADIUS", "CORNER_SIZE", "POST_RADIUS", "Arena", "Layout"]

BALL_RADIUS = 0.08
"""m; fits between the gripper's open paddles and is lower than the sonar ring."""

WALL_HEIGHT = 0.4
"""m; higher than the sonar ring."""

WALL_THICKNESS = 0.1
"""m."""

POST_RADIUS = 0.15
"""m."""

CORNER_SIZE = 0.8
"""Sides of the marked corner, a square, m."""

ROBOT_CLEARANCE = 0.5
"""A robot starts with its axle's middle this far from walls and posts, m; it can then turn freely (0.41 m)."""

BALL_CLEARANCE = 0.6
"""A ball starts with its centre this far from walls and posts, m: where the robot can get at it from all sides."""

PASSAGE = 0.9
"""Free width between two posts, and between a post and a wall, m; the robot needs 0.82 m to turn with a ball."""

START_DISTANCE = 0.8
"""Between the robot and a ball, and between two balls, at the start, m."""

N_PROBES = 200
"""Layouts tried before an arena is said to have no room."""

Position = tuple[float, float]
Pose = tuple[float, float, float]


class Layout(NamedTuple):
    """Where things stand at the start.

    Attributes:
        robot: x, y of the axle's middle, m, and heading, rad, counter-clockwise from +x.
        balls: x, y of each ball, m.
        posts: x, y of each post, m.
    """

    robot: Pose
    balls: tuple[Position, ...]
    posts: tuple[Position, ...]


class Arena:
    """A square floor with walls around; the origin is in its middle, +x to the right and +y up.

    Args:
        size: Inner side, m.
        n_posts: Number of round posts.
        n_balls: Number of balls.

    Raises:
        ValueError: There is no room for robot, balls and posts.
    """

    def __init__(self, size: float, n_posts: int, n_balls: int) -> None:
        self.size = size
        self.half = size / 2
        self._n_posts = n_posts
        self._n_balls = n_balls
        # A generator of its own: whether there is room must not depend on, or use up, an environment's numbers.
        if self._sample(np.random.default_rng(0)) is None:
            raise ValueError(
                f"arena_size {size:g} m has no room for the robot, {n_balls} ball(s) and {n_posts} obstacle(s): "
                "enlarge arena_size, or lower n_obstacles or n_balls"
            )

    @property
    def walls(self) -> list[Box]:
        """The four walls."""
        half_thickness = WALL_THICKNESS / 2
        middle, length = self.half + half_thickness, self.half + WALL_THICKNESS
        z = WALL_HEIGHT / 2
        return [
            *(Box((sign * middle, 0, z), (half_thickness, length, z)) for sign in (-1, 1)),
            *(Box((0, sign * middle, z), (length, half_thickness, z)) for sign in (-1, 1)),
        ]

    @staticmethod
    def posts(layout: Layout) -> list[Post]:
        """The posts of a layout."""
        return [Post((x, y, WALL_HEIGHT / 2), POST_RADIUS, WALL_HEIGHT) for x, y in layout.posts]

    def wall_gap(self, x: float, y: float) -> float:
        """Distance of a point from the nearest wall, m; negative outside."""
        return self.half - max(abs(x), abs(y))

    def in_marked_corner(self, x: float, y: float) -> bool:
        """Whether a point is in the marked corner, the one of largest x and y."""
        edge = self.half - CORNER_SIZE
        return x >= edge and y >= edge

    def sample(self, rng: np.random.Generator) -> Layout:
        """Draws a random layout.

        Raises:
            ValueError: None was found, which in an arena that has little room can happen by bad luck.
        """
        layout = self._sample(rng)
        if layout is None:
            raise ValueError(f"found no layout in {N_PROBES} tries: enlarge arena_size {self.size:g} m")
        return layout

    def check(self, layout: Layout) -> Layout:
        """Returns a layout that nobody drew, if nothing in it overlaps.

        Raises:
            ValueError: Something is in a wall or in something else.
        """
        robot = layout.robot[:2]
        things = [("robot", robot, 0.3)]
        things += [(f"balls[{i}]", ball, BALL_RADIUS) for i, ball in enumerate(layout.balls)]
        things += [(f"obstacles[{i}]", post, POST_RADIUS) for i, post in enumerate(layout.posts)]
        for i, (name, place, radius) in enumerate(things):
            if not all(map(math.isfinite, place)) or self.wall_gap(*place) < radius:
                raise ValueError(f"{name} at {place} is not inside the arena of {self.size:g} m with {radius:g} m to spare")
            for other, other_place, other_radius in things[:i]:
                if math.dist(place, other_place) < radius + other_radius:
                    raise ValueError(f"{name} at {place} overlaps {other} at {other_place}")
        return layout

    def _sample(self, rng: np.random.Generator) -> Layout | None:
        for _ in range(N_PROBES):
            posts = self._scatter(rng, self._n_posts, POST_RADIUS + PASSAGE, [], 2 * POST_RADIUS + PASSAGE, 0)
            if posts is None:
                continue
            balls = self._scatter(
                rng, self._n_balls, BALL_CLEARANCE, posts, START_DISTANCE, POST_RADIUS + BALL_CLEARANCE
            )
            if balls is None:
                continue
            robot = self._free_spot(
                rng, ROBOT_CLEARANCE, [(balls, START_DISTANCE), (posts, POST_RADIUS + ROBOT_CLEARANCE)]
            )
            if robot is not None:
                heading = float(rng.uniform(-math.pi, math.pi))
                return Layout((*robot, heading), tuple(balls), tuple(posts))
        return None

    def _scatter(
        self,
        rng: np.random.Generator,
        n: int,
        margin: float,
        others: Sequence[Position],
        apart: float,
        from_others: float,
    ) -> list[Position] | None:
        """``n`` places ``margin`` from the walls, ``apart`` from each other and ``from_others`` from the others."""
        places: list[Position] = []
        for _ in range(n):
            place = self._free_spot(rng, margin, [(places, apart), (others, from_others)])
            if place is None:
                return None
            places.append(place)
        return places

    def _free_spot(
        self, rng: np.random.Generator, margin: float, taken: Sequence[tuple[Sequence[Position], float]]
    ) -> Position | None:
        """A uniformly random place at a distance from the walls and from what is there, or None after 30 tries."""
        reach = self.half - margin
        if reach <= 0:
            return None
        for _ in range(30):
            x, y = (float(value) for value in rng.uniform(-reach, reach, 2))
            if all(math.dist((x, y), other) >= apart for others, apart in taken for other in others):
                return x, y
        return None
