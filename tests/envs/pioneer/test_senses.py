"""Sonars and retina against geometry."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_options.envs.pioneer.arena import OBSTACLE_RADIUS
from sb3_options.envs.pioneer.body import BALL_RADIUS
from sb3_options.envs.pioneer.env import DISPLACEMENT, GRIPPING, N_SONARS, VISIBLE, WIDTH, PioneerTask
from sb3_options.envs.pioneer.senses import (
    CAMERA_AHEAD,
    FIELD_OF_VIEW,
    MAX_WIDTH,
    N_PIXELS,
    SONAR_MAX,
    SONAR_MIN,
    SONARS,
    Senses,
    Sighting,
    retina,
)
from tests.envs.pioneer.simulators import CLASSES, SIMULATORS

HALF = 2.0
HIDDEN_BALL = (-1.5, -1.5)


@pytest.fixture(params=SIMULATORS)
def cls(request: pytest.FixtureRequest) -> type[PioneerTask]:
    return CLASSES[request.param]


@pytest.fixture
def env(cls: type[PioneerTask]) -> Iterator[PioneerTask]:
    env = cls()
    yield env
    env.close()


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


def test_sonar_ranges_have_bounds(cls: type[PioneerTask]) -> None:
    env = cls(arena_size=12)
    assert observe(env, (0, 0, 0), (5, 5))[3] == SONAR_MAX
    # 90 degrees to the left the sonar is 10 cm off the middle, the wall 14 cm farther, and 30 cm ahead of the ring.
    assert observe(env, (0, 6 - 0.221, math.pi), (5, -5))[6] == pytest.approx(0.121, abs=0.001)
    ranges = Senses(env.simulator, can_hide=False).look((5.8, 0, 0), []).ranges  # inside the ring the wall is nearer
    assert ranges[3] == SONAR_MIN
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


@pytest.mark.parametrize(
    ("bearing", "visible"),
    [(69, True), (-69, True), (75, True), (78, False), (120, False), (180, False), (-100, False)],
)
def test_field_of_view_is_140_degrees(env: PioneerTask, bearing: float, visible: bool) -> None:
    """At 0.8 m the ball is 11.5 degrees wide; beyond 70 + 5.7 degrees nothing of it is in view."""
    observation = observe(env, (0, 0, 0), at(0.8, bearing))
    assert bool(observation[VISIBLE]) == visible
    if not visible:
        assert observation[[DISPLACEMENT, WIDTH]].tolist() == [0, 0]
    else:
        assert abs(observation[DISPLACEMENT]) + observation[WIDTH] / 2 <= FIELD_OF_VIEW / 2 + 1e-6


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


def test_of_two_balls_the_wider_is_shown(cls: type[PioneerTask]) -> None:
    env = cls(n_balls=2, observation="retina")
    for balls in ([at(0.6, 20), at(1.5, -30)], [at(1.5, -30), at(0.6, 20)]):
        observation, _ = env.reset(seed=0, options={"robot": (0, 0, 0), "balls": balls})
        assert observation[DISPLACEMENT] == pytest.approx(math.radians(20), abs=1e-4)
        lit = np.flatnonzero(observation[GRIPPING + 1 :])
        assert lit.min() == pytest.approx((70 - 20 - 7.7) / 2, abs=1)
        assert lit.max() == pytest.approx((70 + 30 + 3.1) / 2, abs=1)
    env.close()


def test_width_of_the_gripped_ball_is_near_its_upper_bound(env: PioneerTask) -> None:
    observe(env, (0, 0, 0), (0.7, 0))
    observation, _, _, _, info = env.step(2)
    assert info["gripping"]
    assert observation[GRIPPING] == 1
    assert 0.9 * MAX_WIDTH < observation[WIDTH] <= np.float32(MAX_WIDTH)
    assert abs(observation[DISPLACEMENT]) < math.radians(3)


def test_pixels_of_the_retina() -> None:
    assert retina([]).tolist() == [0] * N_PIXELS
    whole = retina([Sighting(FIELD_OF_VIEW / 2, -FIELD_OF_VIEW / 2)])
    assert whole.tolist() == [1] * N_PIXELS
    # Pixels are 2 degrees wide, and their middles at odd degrees.
    pixels = retina([Sighting(math.radians(6), math.radians(-2))])
    assert np.flatnonzero(pixels).tolist() == [32, 33, 34, 35]
    assert retina([Sighting(math.radians(0.9), math.radians(-0.9))]).sum() == 0
    edge = retina([Sighting(FIELD_OF_VIEW / 2, FIELD_OF_VIEW / 2 - math.radians(4))])
    assert np.flatnonzero(edge).tolist() == [0, 1]
    assert np.flatnonzero(retina([Sighting(-1.15, -FIELD_OF_VIEW / 2)])).tolist() == [68, 69]
