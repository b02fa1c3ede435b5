"""Where things stand in the Pioneer's arena."""

import math

import numpy as np

from sb3_options.envs.pioneer.arena import (
    BALL_CLEARANCE,
    CORNER_SIZE,
    OBSTACLE_RADIUS,
    PASSAGE,
    ROBOT_CLEARANCE,
    START_DISTANCE,
    Arena,
)


def test_placements_keep_their_distances(rng: np.random.Generator) -> None:
    arena = Arena(4.0, n_obstacles=3, n_balls=2)
    for _ in range(200):
        placement = arena.sample(rng)
        robot = placement.robot[:2]
        assert len(placement.obstacles) == 3
        assert len(placement.balls) == 2
        assert -math.pi <= placement.robot[2] <= math.pi
        assert arena.wall_gap(*robot) >= ROBOT_CLEARANCE
        assert math.dist(*placement.balls) >= START_DISTANCE
        for ball in placement.balls:
            assert arena.wall_gap(*ball) >= BALL_CLEARANCE
            assert math.dist(ball, robot) >= START_DISTANCE
        for i, obstacle in enumerate(placement.obstacles):
            assert arena.wall_gap(*obstacle) >= OBSTACLE_RADIUS + PASSAGE
            assert math.dist(obstacle, robot) >= OBSTACLE_RADIUS + ROBOT_CLEARANCE
            for ball in placement.balls:
                assert math.dist(obstacle, ball) >= OBSTACLE_RADIUS + BALL_CLEARANCE
            for other in placement.obstacles[:i]:
                assert math.dist(obstacle, other) >= 2 * OBSTACLE_RADIUS + PASSAGE


def test_places() -> None:
    arena = Arena(4.0, n_obstacles=0, n_balls=1)
    assert arena.wall_gap(0, 0) == 2
    assert arena.wall_gap(-1.5, 0.3) == 0.5
    assert arena.wall_gap(0, 2.5) == -0.5
    inside = 2 - CORNER_SIZE + 0.01
    assert arena.in_marked_corner(inside, inside)
    assert not arena.in_marked_corner(-inside, inside)
    assert not arena.in_marked_corner(inside, 2 - CORNER_SIZE - 0.01)
