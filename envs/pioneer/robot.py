"""The Pioneer at work: two PD controllers that carry out its actions, and a gripper that closes by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from sb3_options.envs.pioneer.arena import BALL_RADIUS, Placement, Pose, Position
from sb3_options.envs.pioneer.body import (
    AXLE_TRACK,
    BALL,
    BODY,
    FLOOR,
    MIDDLE_HEIGHT,
    PADDLE_OPENING,
    RAY,
    SOLID,
    WHEEL,
    WHEEL_RADIUS,
    add_body,
)
from sb3_options.envs.pioneer.bullet import CONTACT_GAP, Box, Bullet, Cylinder

__all__ = ["CONTROL_RATE", "GRIP_AHEAD", "PHYSICS_RATE", "SOLVER_ITERATIONS", "PioneerRobot"]

BEAM_AHEAD = 0.30
"""Where the break-beam crosses between the paddles, m ahead of the axle."""

BEAM_HALF_WIDTH = PADDLE_OPENING / 2 - BALL_RADIUS + 0.02
"""A ball is between the paddles, not in front of one, if its centre is this close to the middle, m."""

GRIP_AHEAD = 0.31
"""Where the closed gripper holds a ball's centre, m ahead of the axle: 1 cm before the body."""

GRIP_FORCE = 40.0
"""N; holds the ball while the robot accelerates, and gives way before it would lift the robot."""

BALL_DYNAMICS = {
    "lateralFriction": 0.6,
    "rollingFriction": 0.004,
    "spinningFriction": 0.002,
    "restitution": 0.1,
    "linearDamping": 0.3,
    "angularDamping": 0.3,
}
"""A soft ball on carpet: one that was pushed rolls some decimetres."""

BALL_MASS = 0.25
"""kg."""

PHYSICS_RATE = 60
"""Physics steps per second."""

CONTROL_RATE = 30
"""Decisions of the controllers per second."""

SOLVER_ITERATIONS = 10
"""Of Bullet's default 50: a robot on three wheels needs few."""

MOTOR_TORQUE = 2.0
"""N m at each wheel."""


class PDController(NamedTuple):
    """Turns how far it still is, and how fast it goes, into the velocity to command.

    Attributes:
        p: Proportional gain, 1/s.
        d: Derivative gain.
        top: Velocity limit, unit/s.
        acceleration: By how much a command may exceed the last one, unit/s².
        braking: The command is kept to what this deceleration can still stop in time, unit/s².
    """

    p: float
    d: float
    top: float
    acceleration: float
    braking: float

    def command(self, error: float, velocity: float, last: float) -> float:
        """The next command: p · error − d · velocity, within the limits.

        Args:
            error: What is still to go, in the controller's unit.
            velocity: As measured, unit/s.
            last: The last command, unit/s.
        """
        limit = min(self.top, math.sqrt(2 * self.braking * abs(error)), abs(last) + self.acceleration / CONTROL_RATE)
        return min(max(self.p * error - self.d * velocity, -limit), limit)


DISTANCE_CONTROLLER = PDController(p=10.0, d=0.1, top=1.2, acceleration=3.0, braking=3.0)
"""In m. The 2-DX drives up to 1.6 m/s; 3 m/s² takes 27 N, which the tyres hold."""

HEADING_CONTROLLER = PDController(p=12.0, d=0.1, top=math.radians(230), acceleration=15.0, braking=15.0)
"""In rad. The 2-DX turns up to 300 degrees/s."""

DISTANCE_TOLERANCE = 0.006
"""An action is settled only if the robot is this close to its target, m."""

HEADING_TOLERANCE = math.radians(0.6)
"""An action is settled only if the robot is this close to its heading, rad."""

SETTLED_SPEED = 0.05
"""An action is settled only if the robot is slower than this, m/s."""

SETTLED_TURN_RATE = 0.1
"""An action is settled only if the robot turns slower than this, rad/s."""

TIME_LIMIT = 3
"""An action that has not settled is given up after this long, s."""

BACK_OFF = 0.05
"""How far the robot rolls back from a wall that it touched, m: enough to turn away without touching it again."""

ASIDE = 100.0
"""Where balls that were taken away lie, x and y in m: outside of any arena."""

WHEELS = (0, 1)
TORQUES = (MOTOR_TORQUE, MOTOR_TORQUE)


class PioneerRobot:
    """The robot in its scene.

    Args:
        bullet: The physics client.

    Attributes:
        pose: x, y of the axle's middle, m, and heading, rad, of the last tick.
        balls: x, y of each ball's centre that is still in the arena, m, after the last action.
        held: Index of the ball in the gripper, or None.
        on_tick: Called after each control tick, or None.
    """

    def __init__(self, bullet: Bullet) -> None:
        self._bullet = bullet
        self.pose: Pose = (0.0, 0.0, 0.0)
        self.balls: dict[int, Position] = {}
        self.held: int | None = None
        self.on_tick: Callable[[], None] | None = None
        self._grips: list[int] = []
        self._ball_ids: list[int] = []
        self._robot = self._solid = -1

    def build(self, placement: Placement, walls: Sequence[Box], obstacles: Sequence[Cylinder]) -> None:
        """Builds the scene anew, everything at rest."""
        bullet = self._bullet
        bullet.clear()
        floor = bullet.add_floor()
        bullet.set_filter(floor, -1, FLOOR, BALL | WHEEL)
        self._solid = bullet.add_static(walls, obstacles)
        bullet.set_filter(self._solid, -1, SOLID, BALL | BODY | RAY)
        self._ball_ids = [bullet.add_ball(BALL_MASS, BALL_RADIUS, x, y, **BALL_DYNAMICS) for x, y in placement.balls]
        for ball in self._ball_ids:
            bullet.set_filter(ball, -1, BALL, FLOOR | SOLID | BALL | BODY)
        self._robot = add_body(bullet, *placement.robot)
        self._grips = [self._add_grip(ball) for ball in self._ball_ids]
        self.held = None
        self.balls = dict(enumerate(placement.balls))
        self.pose = placement.robot

    def carry_out(self, distance: float, turn: float) -> bool:
        """Moves ahead, or turns, until the controllers have settled.

        A robot that touches a wall or an obstacle stops, rolls back by `BACK_OFF` and turns back to the heading it had.

        Args:
            distance: m ahead.
            turn: rad to the left.

        Returns:
            Whether the robot, or the ball in its gripper, touched a wall or an obstacle.
        """
        # Everything that each of some 16 ticks looks up is looked up once.
        p, client, robot, solid = self._bullet.p, self._bullet.client, self._robot, self._solid
        set_motors, step, get_pose = p.setJointMotorControlArray, p.stepSimulation, p.getBasePositionAndOrientation
        command_speed, command_turn = DISTANCE_CONTROLLER.command, HEADING_CONTROLLER.command
        velocity_control = p.VELOCITY_CONTROL

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
            wheels = ((v - rim) / WHEEL_RADIUS, (v + rim) / WHEEL_RADIUS)
            set_motors(robot, WHEELS, velocity_control, targetVelocities=wheels, forces=TORQUES, physicsClientId=client)
            step(client)
            (x, y, _z), (_qx, _qy, qz, qw) = get_pose(robot, client)
            heading = 2 * math.atan2(qz, qw)
            self.pose = (x, y, heading)
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
            if not touched and self._is_touching(solid):
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
        """Opens the gripper, has the ball taken away, and says where it was.

        Raises:
            RuntimeError: The gripper is open.
        """
        ball = self.held
        if ball is None:
            raise RuntimeError("release() was called with no ball in the gripper")
        self._hold(ball, 0.0)
        self._bullet.place(self._ball_ids[ball], ASIDE + ball, ASIDE, BALL_RADIUS)
        self.held = None
        return self.balls.pop(ball)

    def _locate_balls(self) -> None:
        for ball in self.balls:
            self.balls[ball] = self._bullet.position(self._ball_ids[ball])[:2]

    def _close_on_ball(self) -> None:
        """Closes the gripper if a ball breaks the beam between the paddles."""
        x, y, heading = self.pose
        cos, sin = math.cos(heading), math.sin(heading)
        for ball in self.balls:
            ball_x, ball_y, _z = self._bullet.position(self._ball_ids[ball])
            dx, dy = ball_x - x, ball_y - y
            if abs(dx * cos + dy * sin - BEAM_AHEAD) < BALL_RADIUS and abs(dy * cos - dx * sin) < BEAM_HALF_WIDTH:
                self._hold(ball, GRIP_FORCE)
                self.held = ball
                return

    def _is_touching(self, solid: int) -> bool:
        """Whether the robot or the ball in its gripper touches walls or obstacles."""
        contacts = self._bullet.p.getContactPoints(solid, physicsClientId=self._bullet.client)
        if not contacts:
            return False
        mine = {self._robot} if self.held is None else {self._robot, self._ball_ids[self.held]}
        # Of a contact, 2 is the other body's number and 8 the distance between the surfaces, m.
        return any(contact[2] in mine and contact[8] < CONTACT_GAP for contact in contacts)

    def _hold(self, ball: int, force: float) -> None:
        self._bullet.p.changeConstraint(self._grips[ball], maxForce=force, physicsClientId=self._bullet.client)

    def _add_grip(self, ball: int) -> int:
        """A joint between gripper and ball that is always there, and has a force only while the gripper is closed."""
        p, client = self._bullet.p, self._bullet.client
        grip = p.createConstraint(
            self._robot,
            -1,
            ball,
            -1,
            p.JOINT_POINT2POINT,
            (0, 0, 0),
            (GRIP_AHEAD, 0, BALL_RADIUS - MIDDLE_HEIGHT),
            (0, 0, 0),
            physicsClientId=client,
        )
        p.changeConstraint(grip, maxForce=0, physicsClientId=client)
        return int(grip)
