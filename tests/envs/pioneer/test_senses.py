"""Sonars and retina against geometry."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_options.envs.pioneer.arena import OBSTACLE_RADIUS
from sb3_options.envs.pioneer.body import BALL_RADIUS
from sb3_options.envs.pioneer.env import DISPLACEMENT, N_SONARS, VISIBLE, WIDTH, PioneerTask
from sb3_options.envs.pioneer.senses import CAMERA_AHEAD, FIELD_OF_VIEW, SONAR_MAX, SONARS

HALF = 2.0


def observe(
    env: PioneerTask, robot: tuple[float, float, float], ball: tuple[float, float], **options: object
) -> NDArray[np.float32]:
    observation, _ = env.reset(seed=0, options={"robot": robot, "balls": [ball], **options})
    return observation


def at(distance: float, bearing: float) -> tuple[float, float]:
    """Where a ball is that a robot in the middle, heading along +x, sees at a distance (m) and a bearing (degrees)."""
    return CAMERA_AHEAD + distance * math.cos(math.radians(bearing)), distance * math.sin(math.radians(bearing))


def test_sonars_measure_the_walls(env: PioneerTask) -> None:
    """Each range against the intersection of its beam with the four walls, from many poses."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, y = rng.uniform(-1.2, 1.2, 2)
        heading = rng.uniform(-math.pi, math.pi)
        corner = (math.copysign(1.8, -x), math.copysign(1.8, -y))
        observation = observe(env, (x, y, heading), corner)
        for (ahead, left, angle), measured in zip(SONARS, observation[:N_SONARS], strict=True):
            start = (
                x + ahead * math.cos(heading) - left * math.sin(heading),
                y + ahead * math.sin(heading) + left * math.cos(heading),
            )
            beam = np.array([math.cos(heading + angle), math.sin(heading + angle)])
            distance = min((math.copysign(HALF, d) - s) / d for s, d in zip(start, beam, strict=True))
            assert measured == pytest.approx(min(distance, SONAR_MAX), abs=0.001)


def test_sonars_measure_obstacles_but_not_balls(cls: type[PioneerTask]) -> None:
    env = cls(n_obstacles=1)
    observation = observe(env, (0, 0, 0), (0.8, 0), obstacles=[(1.3, 0)])
    assert observation[3] == pytest.approx(1.3 - OBSTACLE_RADIUS - 0.130, abs=0.001)
    env.close()


@pytest.mark.parametrize("distance", [0.42, 0.5, 0.8, 1.2, 1.7])
@pytest.mark.parametrize("bearing", [-60, -20, 0, 5, 40])
def test_retina_shows_the_analytic_angle_of_a_sphere(env: PioneerTask, distance: float, bearing: float) -> None:
    observation = observe(env, (0, 0, 0), at(distance, bearing))
    assert observation[VISIBLE] == 1
    half_width = math.asin(BALL_RADIUS / distance)
    left = min(math.radians(bearing) + half_width, FIELD_OF_VIEW / 2)
    right = max(math.radians(bearing) - half_width, -FIELD_OF_VIEW / 2)
    assert observation[WIDTH] == pytest.approx(left - right, abs=1e-4)
    assert observation[DISPLACEMENT] == pytest.approx((left + right) / 2, abs=1e-4)


def test_an_obstacle_hides_a_ball_behind_it(cls: type[PioneerTask]) -> None:
    env = cls(n_obstacles=1)
    # The obstacle's edges are seen at ±asin(0.15 / 0.7) = ±12.4 degrees; the ball, at 1.3 m, is 7.1 degrees wide.
    obstacle = [(CAMERA_AHEAD + 0.7, 0)]
    hidden = observe(env, (0, 0, 0), at(1.3, 3), obstacles=obstacle)
    assert hidden[[VISIBLE, DISPLACEMENT, WIDTH]].tolist() == [0, 0, 0]

    edge = math.asin(OBSTACLE_RADIUS / 0.7)
    half_width = math.asin(BALL_RADIUS / 1.3)
    for side in (1, -1):
        partly = observe(env, (0, 0, 0), at(1.3, side * math.degrees(edge)), obstacles=obstacle)
        assert partly[VISIBLE] == 1
        # Sixteen rays: a sixteenth of the width is the resolution.
        assert partly[WIDTH] == pytest.approx(half_width, abs=2 * half_width / 16 + 1e-3)
        assert partly[DISPLACEMENT] == pytest.approx(side * (edge + half_width / 2), abs=2 * half_width / 16)

    whole = observe(env, (0, 0, 0), at(1.3, 25), obstacles=obstacle)
    assert whole[WIDTH] == pytest.approx(2 * half_width, abs=1e-4)
    in_front = observe(env, (0, 0, 0), at(0.45, 0), obstacles=obstacle)
    assert in_front[WIDTH] == pytest.approx(2 * math.asin(BALL_RADIUS / 0.45), abs=1e-4)
    env.close()
