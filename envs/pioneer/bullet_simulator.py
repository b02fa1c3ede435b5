"""The Pioneer in PyBullet: its body, made of Bullet's shapes, and the scene around it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sb3_options.envs.pioneer import body
from sb3_options.envs.pioneer.arena import Box, Cylinder, Placement, Pose, Position
from sb3_options.envs.pioneer.bullet import Bullet
from sb3_options.envs.pioneer.simulator import Point, Simulator

SOLVER_ITERATIONS = 10
"""Bullet's default is 50, but a robot on three wheels needs few."""

BALL_DYNAMICS = {
    "lateralFriction": body.BALL_FRICTION,
    "rollingFriction": body.BALL_ROLLING_FRICTION,
    "spinningFriction": body.BALL_SPINNING_FRICTION,
    "restitution": 0.1,
    "linearDamping": body.BALL_DAMPING,
    "angularDamping": body.BALL_DAMPING,
}

RAY, FLOOR, SOLID, BALL, BODY, WHEEL = 1, 2, 4, 8, 16, 32
"""Collision groups.

Bullet's rays are in the first group, and hit only bodies whose mask includes it: walls and obstacles. Only wheels and
caster meet the floor. Only body and paddles meet walls and balls, because the wheels stick out of the body: they are
balls here (one point of contact each, and no scrubbing).
"""


def add_body(bullet: Bullet, x: float, y: float, heading: float) -> int:
    """Build the robot at a pose (m, rad), and return its number. Joints 0 and 1 are the left and right wheel."""
    p, client = bullet.p, bullet.client
    paddle_x = body.PADDLE_TIP - body.PADDLE_HALF_SIDES[0]
    paddle_y = body.PADDLE_OPENING / 2 + body.PADDLE_HALF_SIDES[1]
    paddle_z = body.PADDLE_HEIGHT - body.MIDDLE_HEIGHT
    shape = p.createCollisionShapeArray(
        shapeTypes=[p.GEOM_CYLINDER, p.GEOM_BOX, p.GEOM_BOX],
        radii=[body.BODY_RADIUS, 0, 0],
        lengths=[body.BODY_TOP - body.BODY_BOTTOM, 0, 0],
        halfExtents=[(0, 0, 0), body.PADDLE_HALF_SIDES, body.PADDLE_HALF_SIDES],
        collisionFramePositions=[(0, 0, 0), (paddle_x, paddle_y, paddle_z), (paddle_x, -paddle_y, paddle_z)],
        physicsClientId=client,
    )
    wheel = p.createCollisionShape(p.GEOM_SPHERE, radius=body.WHEEL_RADIUS, physicsClientId=client)
    caster = p.createCollisionShape(p.GEOM_SPHERE, radius=body.CASTER_RADIUS, physicsClientId=client)
    still = (0, 0, 0, 1)
    robot = int(
        p.createMultiBody(
            body.BODY_MASS,
            shape,
            bullet.looks,
            basePosition=(x, y, body.MIDDLE_HEIGHT),
            baseOrientation=(0, 0, math.sin(heading / 2), math.cos(heading / 2)),
            linkMasses=[body.WHEEL_MASS, body.WHEEL_MASS, body.REAR_MASS],
            linkCollisionShapeIndices=[wheel, wheel, caster],
            linkVisualShapeIndices=[bullet.looks] * 3,
            linkPositions=[
                (0, body.AXLE_TRACK / 2, body.WHEEL_RADIUS - body.MIDDLE_HEIGHT),
                (0, -body.AXLE_TRACK / 2, body.WHEEL_RADIUS - body.MIDDLE_HEIGHT),
                (-body.CASTER_BEHIND, 0, body.CASTER_RADIUS - body.MIDDLE_HEIGHT),
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
    for link, friction in ((0, body.TYRE_FRICTION), (1, body.TYRE_FRICTION), (2, body.CASTER_FRICTION)):
        p.changeDynamics(robot, link, lateralFriction=friction, physicsClientId=client)
        bullet.set_filter(robot, link, WHEEL, FLOOR)
    p.changeDynamics(robot, -1, lateralFriction=body.BODY_FRICTION, physicsClientId=client)
    bullet.set_filter(robot, -1, BODY, SOLID | BALL)
    return robot


WHEELS = (0, 1)
TORQUES = (body.MOTOR_TORQUE, body.MOTOR_TORQUE)


class BulletSimulator(Simulator):
    """A separate scene in PyBullet."""

    def __init__(self, *, gui: bool = False) -> None:
        self.bullet = Bullet(1 / body.CONTROL_RATE, body.PHYSICS_RATE // body.CONTROL_RATE, SOLVER_ITERATIONS, gui=gui)
        self._grips: list[int] = []
        self._balls: list[int] = []
        self._robot = self._solid = -1

    def build(self, placement: Placement, walls: Sequence[Box], obstacles: Sequence[Cylinder]) -> None:
        """As `Simulator.build`."""
        bullet = self.bullet
        bullet.clear()
        floor = bullet.add_floor()
        bullet.set_filter(floor, -1, FLOOR, BALL | WHEEL)
        self._solid = bullet.add_static(walls, obstacles)
        bullet.set_filter(self._solid, -1, SOLID, BALL | BODY | RAY)
        self._balls = [
            bullet.add_ball(body.BALL_MASS, body.BALL_RADIUS, x, y, **BALL_DYNAMICS) for x, y in placement.balls
        ]
        for ball in self._balls:
            bullet.set_filter(ball, -1, BALL, FLOOR | SOLID | BALL | BODY)
        self._robot = add_body(bullet, *placement.robot)
        self._grips = [self._add_grip(ball) for ball in self._balls]

    def drive(self, left: float, right: float) -> Pose:
        """As `Simulator.drive`."""
        p = self.bullet.p
        client = self.bullet.client
        robot = self._robot
        p.setJointMotorControlArray(
            robot, WHEELS, p.VELOCITY_CONTROL, targetVelocities=(left, right), forces=TORQUES, physicsClientId=client
        )
        p.stepSimulation(client)
        (x, y, _z), (_qx, _qy, qz, qw) = p.getBasePositionAndOrientation(robot, client)
        return x, y, 2 * math.atan2(qz, qw)

    def ball(self, ball: int) -> Position:
        """As `Simulator.ball`."""
        return self.bullet.position(self._balls[ball])[:2]

    def hold(self, ball: int) -> None:
        """As `Simulator.hold`."""
        self._set_grip(ball, body.GRIP_FORCE)

    def take_away(self, ball: int) -> None:
        """As `Simulator.take_away`."""
        self._set_grip(ball, 0.0)
        self.bullet.place(self._balls[ball], body.ASIDE + ball, body.ASIDE, body.BALL_RADIUS)

    def is_touching(self, held: int | None) -> bool:
        """As `Simulator.is_touching`."""
        contacts = self.bullet.p.getContactPoints(self._solid, physicsClientId=self.bullet.client)
        if not contacts:
            return False
        mine = {self._robot} if held is None else {self._robot, self._balls[held]}
        # In a contact, 2 is the other body's number and 8 the distance of the surfaces, m: Bullet also reports
        # neighbours that do not touch.
        return any(contact[2] in mine and contact[8] < body.CONTACT_GAP for contact in contacts)

    def ray_fractions(self, starts: Sequence[Point], ends: Sequence[Point]) -> list[float]:
        """As `Simulator.ray_fractions`."""
        return self.bullet.ray_fractions(starts, ends, SOLID)

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        self.bullet.close()

    def _set_grip(self, ball: int, force: float) -> None:
        self.bullet.p.changeConstraint(self._grips[ball], maxForce=force, physicsClientId=self.bullet.client)

    def _add_grip(self, ball: int) -> int:
        """Add a permanent joint between gripper and ball, which exerts force only while the gripper is closed."""
        p, client = self.bullet.p, self.bullet.client
        grip = p.createConstraint(
            self._robot,
            -1,
            ball,
            -1,
            p.JOINT_POINT2POINT,
            (0, 0, 0),
            (body.GRIP_AHEAD, 0, body.BALL_RADIUS - body.MIDDLE_HEIGHT),
            (0, 0, 0),
            physicsClientId=client,
        )
        p.changeConstraint(grip, maxForce=0, physicsClientId=client)
        return int(grip)
