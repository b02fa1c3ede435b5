"""The body of a Pioneer 2-DX with a gripper: its dimensions, and how it is built of Bullet's shapes.

Dimensions and masses are those that ActivMEDIA's "Pioneer 2 Mobile Robot Operation Manual" (1999) specifies for the
2-DX, unless a constant says otherwise. In the robot's frame x points ahead, y to the left and z up, and the origin is
on the floor below the middle of the axle.
"""

from __future__ import annotations

import math

from sb3_options.envs.pioneer.bullet import Bullet

__all__ = [
    "AXLE_TRACK",
    "BALL",
    "BODY",
    "BODY_BOTTOM",
    "BODY_RADIUS",
    "BODY_TOP",
    "FLOOR",
    "MIDDLE_HEIGHT",
    "PADDLE_HALF_SIDES",
    "PADDLE_OPENING",
    "PADDLE_TIP",
    "RAY",
    "SOLID",
    "WHEEL",
    "WHEEL_RADIUS",
    "add_body",
]

BODY_RADIUS = 0.22
"""m: half of the body's 44 cm length. The body, 44 cm by 38 cm with rounded ends, is simulated as the cylinder that
it turns in, so that turning on the spot brings nothing but the gripper nearer to a wall."""

BODY_BOTTOM, BODY_TOP = 0.06, 0.22
"""m above the floor: the deck is at 22 cm; the clearance is rounded up from 5 cm."""

WHEEL_RADIUS = 0.0825
"""m: the wheels' diameter is 16.5 cm."""

AXLE_TRACK = 0.33
"""Between the wheels, m."""

CASTER_RADIUS = 0.03
CASTER_BEHIND = 0.18
"""m; the swivelling rear caster, simulated as a ball without friction."""

BODY_MASS, WHEEL_MASS, REAR_MASS = 5.0, 0.5, 3.0
"""kg, 9 kg in all; the batteries and the caster are in the rear, which keeps the nose up when the robot brakes."""

PADDLE_OPENING = 0.24
"""Between the gripper's open paddles, m; it takes a ball of 16 cm that is up to 4 cm off the middle."""

PADDLE_TIP = 0.34
"""How far the paddles reach ahead of the axle, m."""

PADDLE_HALF_SIDES = (0.08, 0.01, 0.025)
"""Along, across and upwards, m."""

PADDLE_HEIGHT = 0.08
"""Of the paddles' middle above the floor, m."""

MIDDLE_HEIGHT = (BODY_BOTTOM + BODY_TOP) / 2
"""Of the body's middle, Bullet's origin of it, above the floor, m."""

TYRE_FRICTION, CASTER_FRICTION, BODY_FRICTION = 1.0, 0.0, 0.2
"""Coefficients: rubber on carpet, a caster that follows, and painted metal that slides along a wall."""

RAY, FLOOR, SOLID, BALL, BODY, WHEEL = 1, 2, 4, 8, 16, 32
"""Collision groups.

Bullet's rays are in the first, and hit only what is ready to collide with it: walls and obstacles. Only wheels and
caster meet the floor, and only body and paddles meet walls and balls: the wheels are balls here (one point of contact
each, and no scrubbing), which stick out of the body.
"""


def add_body(bullet: Bullet, x: float, y: float, heading: float) -> int:
    """Builds the robot at a pose (m, rad), and returns its number; its joints 0 and 1 are the left and right wheel."""
    p, client = bullet.p, bullet.client
    paddle_x, paddle_y = PADDLE_TIP - PADDLE_HALF_SIDES[0], PADDLE_OPENING / 2 + PADDLE_HALF_SIDES[1]
    paddle_z = PADDLE_HEIGHT - MIDDLE_HEIGHT
    body = p.createCollisionShapeArray(
        shapeTypes=[p.GEOM_CYLINDER, p.GEOM_BOX, p.GEOM_BOX],
        radii=[BODY_RADIUS, 0, 0],
        lengths=[BODY_TOP - BODY_BOTTOM, 0, 0],
        halfExtents=[(0, 0, 0), PADDLE_HALF_SIDES, PADDLE_HALF_SIDES],
        collisionFramePositions=[(0, 0, 0), (paddle_x, paddle_y, paddle_z), (paddle_x, -paddle_y, paddle_z)],
        physicsClientId=client,
    )
    wheel = p.createCollisionShape(p.GEOM_SPHERE, radius=WHEEL_RADIUS, physicsClientId=client)
    caster = p.createCollisionShape(p.GEOM_SPHERE, radius=CASTER_RADIUS, physicsClientId=client)
    still = (0, 0, 0, 1)
    robot = int(
        p.createMultiBody(
            BODY_MASS,
            body,
            bullet.looks,
            basePosition=(x, y, MIDDLE_HEIGHT),
            baseOrientation=(0, 0, math.sin(heading / 2), math.cos(heading / 2)),
            linkMasses=[WHEEL_MASS, WHEEL_MASS, REAR_MASS],
            linkCollisionShapeIndices=[wheel, wheel, caster],
            linkVisualShapeIndices=[bullet.looks] * 3,
            linkPositions=[
                (0, AXLE_TRACK / 2, WHEEL_RADIUS - MIDDLE_HEIGHT),
                (0, -AXLE_TRACK / 2, WHEEL_RADIUS - MIDDLE_HEIGHT),
                (-CASTER_BEHIND, 0, CASTER_RADIUS - MIDDLE_HEIGHT),
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
    for link, friction in ((0, TYRE_FRICTION), (1, TYRE_FRICTION), (2, CASTER_FRICTION)):
        p.changeDynamics(robot, link, lateralFriction=friction, physicsClientId=client)
        bullet.set_filter(robot, link, WHEEL, FLOOR)
    p.changeDynamics(robot, -1, lateralFriction=BODY_FRICTION, physicsClientId=client)
    bullet.set_filter(robot, -1, BODY, SOLID | BALL)
    return robot
