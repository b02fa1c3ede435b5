"""Whether the simulated robot moves as a robot does, and what simulating it costs."""

import math

import numpy as np
import pytest

from sb3_options.envs.pioneer.body import BODY_RADIUS, GRIP_AHEAD
from sb3_options.envs.pioneer.env import ACTIONS, PioneerTask

LONG = 2


def start(env: PioneerTask, x: float, y: float, heading: float, ball: tuple[float, float] = (-1.5, -1.5)) -> None:
    env.reset(seed=0, options={"robot": (x, y, heading), "balls": [ball]})


@pytest.mark.parametrize("action", range(len(ACTIONS)))
def test_distances_within_2_cm_and_angles_within_2_degrees(env: PioneerTask, action: int) -> None:
    """From many headings, and twice in a row: what the first action leaves behind must not spoil the second."""
    distance, turn = ACTIONS[action]
    for heading in np.linspace(-math.pi, math.pi, 9):
        start(env, 0.7 - 0.5 * math.cos(heading), 0.7 - 0.5 * math.sin(heading), heading)
        for _ in range(2):
            x0, y0, heading0 = env.robot_pose
            touched = env.step(action)[4]["touched_wall"]
            x, y, after = env.robot_pose
            assert not touched
            assert math.hypot(x - x0 - distance * math.cos(heading0), y - y0 - distance * math.sin(heading0)) < 0.02
            assert abs(math.remainder(after - heading0 - turn, math.tau)) < math.radians(2)


@pytest.mark.parametrize("heading", np.linspace(0, math.tau, 12, endpoint=False).tolist())
def test_no_action_passes_through_a_wall(env: PioneerTask, heading: float) -> None:
    start(env, 0.5, 0.5, heading)
    touches = 0
    for _ in range(10):
        reward, info = env.step(LONG)[1::3]
        x, y, _ = env.robot_pose
        touches += info["touched_wall"]
        assert reward == pytest.approx(-1.1 if info["touched_wall"] else -0.1)
        assert max(abs(x), abs(y)) < 2 - BODY_RADIUS
    assert touches >= 5


def test_an_obstacle_stops_the_robot_like_a_wall(cls: type[PioneerTask]) -> None:
    env = cls(n_obstacles=1)
    options = {"robot": (-1, 0, 0), "balls": [(-1.5, -1.5)], "obstacles": [(0.2, 0)]}
    env.reset(seed=0, options=options)
    touched = [env.step(LONG)[4]["touched_wall"] for _ in range(3)]
    assert touched == [False, True, True]
    assert env.robot_pose[0] < 0.2 - 0.15 - BODY_RADIUS
    env.close()


@pytest.mark.parametrize(("off", "gripped"), [(0, True), (0.03, True), (0.10, True), (0.16, False), (0.30, False)])
def test_paddles_take_a_ball_or_push_it_aside(env: PioneerTask, off: float, gripped: bool) -> None:
    """A paddle is 12 to 14 cm off the middle: it sends a ball to the side on which its centre is."""
    for side in (1, -1):
        start(env, -1.01, 0, 0, ball=(-0.5, side * off))
        assert env.step(LONG)[4]["gripping"] == gripped
        x, y = env.ball_positions[0]
        if gripped:
            robot_x, robot_y, _ = env.robot_pose
            assert (x - robot_x, y - robot_y) == pytest.approx((GRIP_AHEAD, 0), abs=0.02)
        elif off < 0.2:
            assert side * y > off + 0.02
        else:
            assert (x, y) == pytest.approx((-0.5, side * off), abs=0.002)
