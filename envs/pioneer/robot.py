"""The Pioneer's control: two PD controllers that carry out its actions, and a gripper that closes by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from sb3_options.envs.pioneer.arena import Box, Cylinder, Placement, Pose, Position
from sb3_options.envs.pioneer.body import AXLE_TRACK, BALL_RADIUS, CONTROL_RATE, PADDLE_OPENING, WHEEL_RADIUS
from sb3_options.envs.pioneer.simulator import Simulator

BEAM_AHEAD = 0.30  # place of the break-beam between the paddles, m ahead of the axle
# A ball is between the paddles, not in front of one, if its centre is this close to the middle, m.
BEAM_HALF_WIDTH = PADDLE_OPENING / 2 - BALL_RADIUS + 0.02


class PDController(NamedTuple):
    """Turns the remaining way and the current velocity into a velocity command."""

    p: float  # proportional gain, 1/s
    d: float  # derivative gain
    top: float  # velocity limit, unit/s
    acceleration: float  # limit on the increase of the command, unit/s²
    braking: float  # deceleration that can still stop the commanded velocity in time, unit/s²

    def command(self, error: float, velocity: float, last: float) -> float:
        """Return the next command: p · error − d · velocity, within the limits.

        ``error`` is the remaining way, ``velocity`` measured, and ``last`` the last command.
        """
        limit = min(self.top, math.sqrt(2 * self.braking * abs(error)), abs(last) + self.acceleration / CONTROL_RATE)
        return min(max(self.p * error - self.d * velocity, -limit), limit)


# In m. The 2-DX drives up to 1.6 m/s. 3 m/s² takes 27 N, which the tyres can hold.
DISTANCE_CONTROLLER = PDController(p=10.0, d=0.1, top=1.2, acceleration=3.0, braking=3.0)
# In rad. The 2-DX turns up to 300 degrees/s.
HEADING_CONTROLLER = PDController(p=12.0, d=0.1, top=math.radians(230), acceleration=15.0, braking=15.0)

# An action is settled once the robot is this close to its target and heading, and slower than this.
DISTANCE_TOLERANCE = 0.006  # m
HEADING_TOLERANCE = math.radians(0.6)
SETTLED_SPEED = 0.05  # m/s
SETTLED_TURN_RATE = 0.1  # rad/s
TIME_LIMIT = 3  # an action that has not settled ends after this time, s

BACK_OFF = 0.05  # m that the robot rolls back from a wall after a touch: enough to turn away without another touch


class PioneerRobot:
    """The robot in its scene."""

    STATE = ("pose", "balls", "held")

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self.pose: Pose = (0.0, 0.0, 0.0)  # x, y of the axle's middle, m, and heading, rad, of the last tick
        self.balls: dict[int, Position] = {}  # centres of those still in the arena, m, after the last action
        self.held: int | None = None  # index of the ball in the gripper
        self.on_tick: Callable[[], None] | None = None

    def build(self, placement: Placement, walls: Sequence[Box], obstacles: Sequence[Cylinder]) -> None:
        """Build a new scene, with everything at rest."""
        self._simulator.build(placement, walls, obstacles)
        self.held = None
        self.balls = dict(enumerate(placement.balls))
        self.pose = placement.robot

    def carry_out(self, distance: float, turn: float) -> bool:
        """Move ahead (m), or turn (rad to the left), until the controllers have settled.

        A robot that touches a wall or an obstacle, or whose ball in the gripper does, stops, rolls back by `BACK_OFF`
        and turns to its earlier heading. Return whether it did.
        """
        # Looked up once, not in each of some 16 ticks.
        drive, is_touching = self._simulator.drive, self._simulator.is_touching
        command_speed, command_turn = DISTANCE_CONTROLLER.command, HEADING_CONTROLLER.command

        x0, y0, heading0 = self.pose
        ahead_x, ahead_y = math.cos(heading0), math.sin(heading0)
        v = w = 0.0  # as commanded, m/s and rad/s
        speed = turn_rate = 0.0  # as measured
        covered = turned = 0.0
        touched = False
        for _ in range(TIME_LIMIT * CONTROL_RATE):
            v = command_speed(distance - covered, speed, v)
            w = command_turn(turn - turned, turn_rate, w)
            rim = w * AXLE_TRACK / 2
            x, y, heading = self.pose = drive((v - rim) / WHEEL_RADIUS, (v + rim) / WHEEL_RADIUS)
            progress = (x - x0) * ahead_x + (y - y0) * ahead_y
            # remainder: the rotation since the last tick, whichever way the heading wraps around
            rotation = math.remainder(heading - heading0 - turned, math.tau)
            speed, turn_rate = (progress - covered) * CONTROL_RATE, rotation * CONTROL_RATE
            covered, turned = progress, turned + rotation
            if self.held is None:
                self._close_on_ball()
            if self.on_tick is not None:
                self._locate_balls()
                self.on_tick()
            if not touched and is_touching(self.held):
                touched = True
                distance, turn = covered - BACK_OFF, 0.0
            if (
                abs(distance - covered) < DISTANCE_TOLERANCE
                and abs(turn - turned) < HEADING_TOLERANCE
                and abs(speed) < SETTLED_SPEED
                and abs(turn_rate) < SETTLED_TURN_RATE
            ):
                break
        self._locate_balls()
        return touched

    def release(self) -> Position:
        """Open the gripper, take the ball away, and return its last position."""
        ball = self.held
        assert ball is not None  # `PioneerTask.step` has asked
        self._simulator.take_away(ball)
        self.held = None
        return self.balls.pop(ball)

    def _locate_balls(self) -> None:
        for ball in self.balls:
            self.balls[ball] = self._simulator.ball(ball)

    def _close_on_ball(self) -> None:
        """Close the gripper if a ball breaks the beam between the paddles."""
        x, y, heading = self.pose
        cos, sin = math.cos(heading), math.sin(heading)
        for ball in self.balls:
            ball_x, ball_y = self._simulator.ball(ball)
            dx, dy = ball_x - x, ball_y - y
            if abs(dx * cos + dy * sin - BEAM_AHEAD) < BALL_RADIUS and abs(dy * cos - dx * sin) < BEAM_HALF_WIDTH:
                self._simulator.hold(ball)
                self.held = ball
                return
