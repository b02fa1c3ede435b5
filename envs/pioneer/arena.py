"""The Pioneer's arena: four walls, round obstacles, and valid places of robot, balls and obstacles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_options.envs.pioneer.body import BALL_RADIUS, BODY_RADIUS
from sb3_options.state import storable

WALL_HEIGHT = 0.4  # m; above the sonar ring
WALL_THICKNESS = 0.1  # m
OBSTACLE_RADIUS = 0.15  # m
CORNER_SIZE = 0.8  # side of the marked square corner, m

# Least initial distances, m. The robot's are of the middle of its axle: turning freely takes 0.41 m, turning with a
# ball 0.82 m. A ball's are of its centre: the robot can reach it from all sides.
ROBOT_CLEARANCE = 0.5  # between the robot and walls or obstacles
BALL_CLEARANCE = 0.6  # between a ball and walls or obstacles
START_DISTANCE = 0.8  # between the robot and a ball, and between two balls
PASSAGE = 0.85  # free width between obstacles, and between obstacle and wall

N_PROBES = 200  # placements tried before an arena counts as too small
N_SPOTS = 20  # places tried for one thing of a placement

GRIPPER_AHEAD, GRIPPER_RADIUS = 0.28, 0.14  # circle around the paddles: centre ahead of the axle and radius, m

Position = tuple[float, float]
Distance = tuple[Sequence[Position], float]
Pose = tuple[float, float, float]


class Box(NamedTuple):
    """An upright static box: middle and half sides, m."""

    middle: tuple[float, float, float]
    half_sides: tuple[float, float, float]


class Cylinder(NamedTuple):
    """An upright static cylinder: middle, radius and height, m."""

    middle: tuple[float, float, float]
    radius: float
    height: float


@storable
class Placement(NamedTuple):
    """Initial places of things."""

    robot: Pose  # x, y of the axle's middle, m, and heading, rad, counter-clockwise from +x
    balls: tuple[Position, ...]  # x, y of each, m
    obstacles: tuple[Position, ...]  # x, y of each middle, m


class Arena:
    """A square floor surrounded by walls. The origin is in its middle, +x to the right and +y up."""

    def __init__(self, size: float, n_obstacles: int, n_balls: int) -> None:
        self.size = size
        self.half = size / 2
        self._n_obstacles = n_obstacles
        self._n_balls = n_balls
        # A separate generator: the check must neither depend on an environment's generator nor advance it.
        probe = np.random.default_rng(0)
        if all(self._draw(probe) is None for _ in range(N_PROBES)):
            raise ValueError(
                f"arena_size {size:g} m has no room for the robot, {n_balls} ball(s) and {n_obstacles} obstacle(s): "
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

    def given(self, options: dict[str, Any]) -> dict[str, Any]:
        """Read fields of a `Placement` from the options of an environment's reset."""
        shapes = {"robot": (3,), "balls": (self._n_balls, 2), "obstacles": (self._n_obstacles, 2)}
        fields: dict[str, Any] = {}
        for key, value in options.items():
            if key not in shapes:
                raise ValueError(
                    f"options has the unknown key {key!r}: only {', '.join(map(repr, shapes))} are understood"
                )
            try:
                numbers = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError):
                numbers = np.array(math.nan)
            if numbers.shape != shapes[key] or not np.isfinite(numbers).all():
                raise ValueError(f"options[{key!r}] must be finite numbers of shape {shapes[key]}, got {value!r}")
            fields[key] = tuple(numbers.tolist() if key == "robot" else map(tuple, numbers.tolist()))
        return fields

    @staticmethod
    def obstacles(placement: Placement) -> list[Cylinder]:
        """Return the obstacles of a placement."""
        return [Cylinder((x, y, WALL_HEIGHT / 2), OBSTACLE_RADIUS, WALL_HEIGHT) for x, y in placement.obstacles]

    def wall_gap(self, x: float, y: float) -> float:
        """Return the distance of a point from the nearest wall, m; negative outside."""
        return self.half - max(abs(x), abs(y))

    def in_marked_corner(self, x: float, y: float) -> bool:
        """Whether a point is in the marked corner, the one with the largest x and y."""
        edge = self.half - CORNER_SIZE
        return x >= edge and y >= edge

    def sample(self, rng: np.random.Generator, **given: Any) -> Placement:
        """Draw a random placement."""
        refusal = f"found no placement in {N_PROBES} tries: enlarge arena_size, {self.size:g} m"
        for _ in range(N_PROBES):
            placement = self._draw(rng)
            if placement is not None and not given:
                return placement
            if placement is not None:
                placement = placement._replace(**given)
                overlap = self._overlap(placement)
                if not overlap:
                    return placement
                refusal = overlap
        raise ValueError(refusal)

    def _overlap(self, placement: Placement) -> str:
        """Say which thing of a placement overlaps a wall or another thing; empty if none does."""
        x, y, heading = placement.robot
        gripper = (x + GRIPPER_AHEAD * math.cos(heading), y + GRIPPER_AHEAD * math.sin(heading))
        things = [("the robot", (x, y), BODY_RADIUS), ("the robot's gripper", gripper, GRIPPER_RADIUS)]
        things += [(f"balls[{i}]", ball, BALL_RADIUS) for i, ball in enumerate(placement.balls)]
        things += [(f"obstacles[{i}]", place, OBSTACLE_RADIUS) for i, place in enumerate(placement.obstacles)]
        for i, (name, place, radius) in enumerate(things):
            where = f"({place[0]:.2f}, {place[1]:.2f})"
            if self.wall_gap(*place) < radius:
                return f"{name} at {where} m is in a wall of the arena, which ends at ±{self.half:g} m"
            for other, other_place, other_radius in things[: 0 if i == 1 else i]:
                if math.dist(place, other_place) < radius + other_radius:
                    return f"{name} at {where} m overlaps {other}"
        return ""

    def _draw(self, rng: np.random.Generator) -> Placement | None:
        """Try to draw a placement once."""
        far_from_obstacles = OBSTACLE_RADIUS + BALL_CLEARANCE
        obstacles = self._scatter(rng, self._n_obstacles, OBSTACLE_RADIUS + PASSAGE, 2 * OBSTACLE_RADIUS + PASSAGE)
        if obstacles is None:
            return None
        balls = self._scatter(rng, self._n_balls, BALL_CLEARANCE, START_DISTANCE, [(obstacles, far_from_obstacles)])
        if balls is None:
            return None
        robot = self._spot(
            rng, ROBOT_CLEARANCE, [(balls, START_DISTANCE), (obstacles, OBSTACLE_RADIUS + ROBOT_CLEARANCE)]
        )
        if robot is None:
            return None
        return Placement((*robot, float(rng.uniform(-math.pi, math.pi))), tuple(balls), tuple(obstacles))

    def _scatter(
        self, rng: np.random.Generator, n: int, margin: float, apart: float, others: Sequence[Distance] = ()
    ) -> list[Position] | None:
        """Draw ``n`` random places, ``margin`` from the walls and ``apart`` from each other, or return None."""
        places: list[Position] = []
        for _ in range(n):
            place = self._spot(rng, margin, [(places, apart), *others])
            if place is None:
                return None
            places.append(place)
        return places

    def _spot(self, rng: np.random.Generator, margin: float, others: Sequence[Distance]) -> Position | None:
        """Draw a uniformly random place ``margin`` from the walls and far enough from others, or return None."""
        reach = self.half - margin
        if reach <= 0:
            return None
        for _ in range(N_SPOTS):
            x, y = rng.uniform(-reach, reach, 2).tolist()
            if all(math.hypot(x - other[0], y - other[1]) >= apart for places, apart in others for other in places):
                return x, y
        return None
