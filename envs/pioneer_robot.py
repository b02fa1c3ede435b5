"""A simulated Pioneer 2-DX: its body, its gripper, and the two PD controllers that carry out its actions.

Dimensions and limits are those of ActivMedia's "Pioneer 2 Mobile Robot Operation Manual" (1999), table of
specifications, unless a constant says otherwise. In the robot's frame x points ahead, y to the left and z up, and
the origin is on the floor below the middle of the axle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

from sb3_options.envs.arena import BALL_RADIUS, Layout, Pose
from sb3_options.envs.bullet import Box, Bullet, Post

__all__ = ["BODY_RADIUS", "FINGER_TIP", "GRIP_AHEAD", "PADDLE_OPENING", "SOLID", "PioneerRobot"]

BODY_RADIUS = 0.22
"""m: half of the 44 cm length. The rounded body (44 x 38 cm) is simulated as the cylinder it turns in."""

BODY_BOTTOM, BODY_TOP = 0.06, 0.22
"""m above the floor: ground clearance of about 6 cm, deck at 22 cm."""

WHEEL_RADIUS = 0.0825
"""m: the wheels' diameter is 16.5 cm."""

AXLE_TRACK = 0.33
"""Between the wheels, m."""

CASTER_RADIUS = 0.03
CASTER_BEHIND = 0.18
"""m; the single rear caster, a ball without friction here."""

BODY_MASS, WHEEL_MASS, REAR_MASS = 5.0, 0.5, 3.0
"""kg, 9 kg in all; the batteries and the caster are in the rear, which keeps the nose up when the robot brakes."""

PADDLE_OPENING = 0.24
"""Between the gripper's open paddles, m."""

FINGER_TIP = 0.34
"""How far the paddles reach ahead of the axle, m."""

FINGER_HALF_SIDES = (0.08, 0.01, 0.025)
"""m."""

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

TYRE_FRICTION = 1.0
BUMPER_FRICTION = 0.2

# --- Physics and control rates.
PHYSICS_RATE = 60
"""Physics steps per second."""

CONTROL_RATE = 30
"""Decisions of the controllers per second."""

SOLVER_ITERATIONS = 10
"""Of Bullet's default 50: a robot on three wheels needs few."""

TOP_SPEED = 1.2
"""m/s; the robot's limit is 1.6 m/s."""

TOP_TURN_RATE = math.radians(230)
"""rad/s; the robot's limit is 300 degrees/s."""

ACCELERATION = 3.0
"""m/s²: 27 N, which the tyres hold."""

BRAKING = 3.0
"""m/s²; the speed is kept to what this deceleration can still stop before the target."""

TURN_ACCELERATION = 15.0
"""rad/s²."""

TURN_BRAKING = 15.0
"""rad/s²."""

MOTOR_TORQUE = 2.0
"""N m at each wheel."""

DISTANCE_GAINS: Final = (10.0, 0.1)
"""Proportional gain, (m/s)/m, and derivative gain, (m/s)/(m/s), of the distance controller."""

HEADING_GAINS: Final = (12.0, 0.1)
"""Proportional gain, (rad/s)/rad, and derivative gain of the heading controller."""

DISTANCE_TOLERANCE = 0.006
"""An action is settled when the robot is this close to its target, m, ..."""

HEADING_TOLERANCE = math.radians(0.6)
"""... this close to its heading, rad, ..."""

SETTLED_SPEED = 0.05
"""... slower than this, m/s, ..."""

SETTLED_TURN_RATE = 0.1
"""... and turning slower than this, rad/s."""

TIME_LIMIT = 3.0
"""An action that has not settled is given up after this long, s."""

BACK_OFF = 0.05
"""How far the robot rolls back from a wall that it touched, m: enough to turn away without touching it again."""

# Collision groups.
FLOOR, SOLID, BALL, BODY, WHEEL = 1, 2, 4, 8, 16


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
        self.balls: dict[int, tuple[float, float]] = {}
        self.held: int | None = None
        self.on_tick: Callable[[], None] | None = None
        self._grips: list[int] = []
        self._ball_ids: list[int] = []
        self._robot = self._solid = -1
        self._motion = (0.0, 0.0)

    def build(self, layout: Layout, walls: Sequence[Box], posts: Sequence[Post]) -> None:
        """Builds the scene anew, everything at rest."""
        bullet = self._bullet
        bullet.clear()
        floor = bullet.add_floor()
        bullet.set_filter(floor, -1, FLOOR, BALL | WHEEL)
        self._solid = bullet.add_static(walls, posts)
        bullet.set_filter(self._solid, -1, SOLID, BALL | BODY)
        self._ball_ids = [bullet.add_ball(BALL_MASS, BALL_RADIUS, x, y, **BALL_DYNAMICS) for x, y in layout.balls]
        for ball in self._ball_ids:
            bullet.set_filter(ball, -1, BALL, FLOOR | SOLID | BALL | BODY)
        self._robot = self._add_robot(layout.robot)
        self._grips = [self._add_grip(ball) for ball in self._ball_ids]
        self.held = None
        self.balls = dict(enumerate(layout.balls))
        self.pose = layout.robot
        self._motion = (0.0, 0.0)

    def carry_out(self, distance: float, turn: float) -> bool:
        """Moves ahead, or turns, until the controllers have settled.

        A robot that touches a wall or a post stops and backs off: it rolls back `BACK_OFF`, or turns back to the
        heading it had.

        Args:
            distance: m ahead.
            turn: rad to the left.

        Returns:
            Whether the robot, or the ball in its gripper, touched a wall or a post.
        """
        p, client, robot, solid = self._bullet.p, self._bullet.client, self._robot, self._solid
        step, get_pose, get_contacts = p.stepSimulation, p.getBasePositionAndOrientation, p.getContactPoints
        set_motors, motors, control = p.setJointMotorControlArray, (0, 1), p.VELOCITY_CONTROL
        torques = (MOTOR_TORQUE, MOTOR_TORQUE)
        tick = 1 / CONTROL_RATE
        distance_p, distance_d = DISTANCE_GAINS
        heading_p, heading_d = HEADING_GAINS
        gain, turn_gain = ACCELERATION * tick, TURN_ACCELERATION * tick
        v = w = 0.0  # as commanded
        to_wheel = 1 / WHEEL_RADIUS
        half_track = AXLE_TRACK / 2

        x0, y0, heading0 = self.pose
        ahead_x, ahead_y = math.cos(heading0), math.sin(heading0)
        speed = turn_rate = 0.0  # as measured
        covered = turned = 0.0
        touched = False
        for _ in range(int(TIME_LIMIT * CONTROL_RATE)):
            error = distance - covered
            limit = min(TOP_SPEED, math.sqrt(2 * BRAKING * abs(error)), abs(v) + gain)
            v = min(max(distance_p * error - distance_d * speed, -limit), limit)
            error = turn - turned
            limit = min(TOP_TURN_RATE, math.sqrt(2 * TURN_BRAKING * abs(error)), abs(w) + turn_gain)
            w = min(max(heading_p * error - heading_d * turn_rate, -limit), limit)
            rim = w * half_track
            set_motors(
                robot,
                motors,
                control,
                targetVelocities=((v - rim) * to_wheel, (v + rim) * to_wheel),
                forces=torques,
                physicsClientId=client,
            )
            step(client)
            (x, y, _z), (_, _, qz, qw) = get_pose(robot, client)
            heading = 2 * math.atan2(qz, qw)
            progress = (x - x0) * ahead_x + (y - y0) * ahead_y
            rotation = heading - heading0
            rotation -= 2 * math.pi * round((rotation - turned) / (2 * math.pi))
            speed, turn_rate = (progress - covered) / tick, (rotation - turned) / tick
            covered, turned = progress, rotation
            self.pose = (x, y, heading)
            if self.held is None:
                self._close_on_ball()
            if self.on_tick is not None:
                self.on_tick()
            contacts = get_contacts(solid, physicsClientId=client)
            if contacts and not touched and self._is_touch(contacts):
                touched = True
                distance = covered - BACK_OFF if distance else distance
                turn = 0.0
            if (
                abs(distance - covered) < DISTANCE_TOLERANCE
                and abs(turn - turned) < HEADING_TOLERANCE
                and abs(speed) < SETTLED_SPEED
                and abs(turn_rate) < SETTLED_TURN_RATE
            ):
                break
        for ball in self.balls:
            bx, by, _ = get_pose(self._ball_ids[ball], client)[0]
            self.balls[ball] = (bx, by)
        return touched

    def release(self) -> None:
        """Opens the gripper and has the ball taken away."""
        ball = self.held
        if ball is not None:
            self._hold(ball, 0.0)
            self._bullet.place(self._ball_ids[ball], 100.0 + ball, 100.0, BALL_RADIUS)
            del self.balls[ball]
            self.held = None

    def _close_on_ball(self) -> None:
        """Closes the gripper if a ball breaks the beam between the paddles."""
        x, y, heading = self.pose
        cos, sin = math.cos(heading), math.sin(heading)
        for ball in self.balls:
            bx, by, _ = self._bullet.position(self._ball_ids[ball])
            dx, dy = bx - x, by - y
            if abs(dx * cos + dy * sin - BEAM_AHEAD) < BALL_RADIUS and abs(dy * cos - dx * sin) < BEAM_HALF_WIDTH:
                self._hold(ball, GRIP_FORCE)
                self.held = ball
                return

    def _is_touch(self, contacts: Sequence[tuple[float, ...]]) -> bool:
        mine = {self._robot} if self.held is None else {self._robot, self._ball_ids[self.held]}
        return any(contact[2] in mine and contact[8] < 0.002 for contact in contacts)

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
            (GRIP_AHEAD, 0, BALL_RADIUS - (BODY_BOTTOM + BODY_TOP) / 2),
            (0, 0, 0),
            physicsClientId=client,
        )
        p.changeConstraint(grip, maxForce=0, physicsClientId=client)
        return int(grip)

    def _add_robot(self, pose: Pose) -> int:
        p, client = self._bullet.p, self._bullet.client
        x, y, heading = pose
        middle = (BODY_BOTTOM + BODY_TOP) / 2
        finger_x, finger_y = FINGER_TIP - FINGER_HALF_SIDES[0], PADDLE_OPENING / 2 + FINGER_HALF_SIDES[1]
        finger_z = BALL_RADIUS - middle
        body = p.createCollisionShapeArray(
            shapeTypes=[p.GEOM_CYLINDER, p.GEOM_BOX, p.GEOM_BOX],
            radii=[BODY_RADIUS, 0, 0],
            lengths=[BODY_TOP - BODY_BOTTOM, 0, 0],
            halfExtents=[(0, 0, 0), FINGER_HALF_SIDES, FINGER_HALF_SIDES],
            collisionFramePositions=[(0, 0, 0), (finger_x, finger_y, finger_z), (finger_x, -finger_y, finger_z)],
            physicsClientId=client,
        )
        wheel = p.createCollisionShape(p.GEOM_SPHERE, radius=WHEEL_RADIUS, physicsClientId=client)
        caster = p.createCollisionShape(p.GEOM_SPHERE, radius=CASTER_RADIUS, physicsClientId=client)
        still = (0, 0, 0, 1)
        robot = int(
            p.createMultiBody(
                BODY_MASS,
                body,
                basePosition=(x, y, middle),
                baseOrientation=(0, 0, math.sin(heading / 2), math.cos(heading / 2)),
                linkMasses=[WHEEL_MASS, WHEEL_MASS, REAR_MASS],
                linkCollisionShapeIndices=[wheel, wheel, caster],
                linkVisualShapeIndices=[-1, -1, -1],
                linkPositions=[
                    (0, AXLE_TRACK / 2, WHEEL_RADIUS - middle),
                    (0, -AXLE_TRACK / 2, WHEEL_RADIUS - middle),
                    (-CASTER_BEHIND, 0, CASTER_RADIUS - middle),
                ],
                linkOrientations=[still] * 3,
                linkInertialFramePositions=[(0, 0, 0)] * 3,
                linkInertialFrameOrientations=[still] * 3,
                linkParentIndices=[0, 0, 0],
                linkJointTypes=[p.JOINT_REVOLUTE, p.JOINT_REVOLUTE, p.JOINT_FIXED],
                linkJointAxis=[(0, 1, 0), (0, 1, 0), (0, 0, 1)],
                physicsClientId=client,
            )
        )
        for link, friction in enumerate((TYRE_FRICTION, TYRE_FRICTION, 0.0, BUMPER_FRICTION), start=0):
            link = link if link < 3 else -1
            p.changeDynamics(robot, link, lateralFriction=friction, physicsClientId=client)
            if link < 0:
                self._bullet.set_filter(robot, link, BODY, SOLID | BALL)
            else:
                self._bullet.set_filter(robot, link, WHEEL, FLOOR)
        return robot
