"""The Pioneer's scene as MJCF, MuJoCo's XML: the body, balls, walls, obstacles, and pairs that may touch.

Sizes, masses, inertias, friction and damping are those of the scene in PyBullet. Contacts are listed pair by pair,
because MuJoCo would take the larger of two frictions, while Bullet multiplies them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations, product
from xml.etree.ElementTree import Element, SubElement, tostring

from sb3_options.envs.pioneer import body
from sb3_options.envs.pioneer.arena import Box, Cylinder, Placement

# Parts of the robot that touch walls and balls. Its wheels do not: they are balls that stick out of the body.
BODY_GEOMS = ("body", "left paddle", "right paddle")

SOLID_GROUP, OTHER_GROUP = 1, 0  # groups of geoms: walls and obstacles, which rays hit, and all others

MOTOR_GAIN = 0.95
"""N m s / rad. With it each action takes as long as in PyBullet (12, 18, 27, 9 and 18 ticks for the five sizes), and
ends within 4 mm and 0.2 degrees of PyBullet's end. It was chosen by measurement among gains from 0.3 to 1.8. Bullet's
motors are constraints without a gain, but ten solver iterations bring a wheel only part of the way to its velocity."""

HARDNESS = {"solref": f"{2 / body.PHYSICS_RATE:g} 1", "solimp": "0.9 0.95 0.001"}
"""As hard as MuJoCo's default contacts and the time step allow. With harder ones the wheels hop when the gripper closes
on a ball, and spin up in the air. Actions then take up to twice as long as in PyBullet."""

# Depth of robot and balls in the floor at rest, m. They start there, because without pressure there is no friction.
SINK = 6e-4

_UNPAIRED = {"contype": "0", "conaffinity": "0"}  # only listed pairs touch


def mjcf(placement: Placement, walls: Sequence[Box], obstacles: Sequence[Cylinder]) -> str:
    """Return the scene as MJCF."""
    root = Element("mujoco", model="Pioneer 2-DX")
    _add(root, "compiler", angle="radian", autolimits="true")
    physics = {"timestep": repr(1 / body.PHYSICS_RATE), "gravity": _numbers(0, 0, -body.GRAVITY)}
    _add(root, "option", **physics, integrator="Euler", cone="elliptic", impratio="10")
    world = _add(root, "worldbody")
    _add(world, "geom", name="floor", type="plane", size="0 0 1", group=str(OTHER_GROUP), **_UNPAIRED)
    solid = {"group": str(SOLID_GROUP), **_UNPAIRED}
    for i, (middle, half_sides) in enumerate(walls):
        _add(world, "geom", name=solid_name(i), type="box", pos=_numbers(*middle), size=_numbers(*half_sides), **solid)
    for i, (middle, radius, height) in enumerate(obstacles, len(walls)):
        size = _numbers(radius, height / 2)
        _add(world, "geom", name=solid_name(i), type="cylinder", pos=_numbers(*middle), size=size, **solid)
    _add_robot(world, placement)
    n_balls = len(placement.balls)
    for i, (x, y) in enumerate(placement.balls):
        _add_ball(world, ball_name(i), x, y)
    _add_contacts(root, len(walls) + len(obstacles), n_balls)
    equality = _add(root, "equality")
    for i in range(n_balls):
        # Between sites, because an anchor would be at the ball's initial place.
        sites = {"site1": "grip", "site2": ball_name(i)}
        _add(equality, "connect", name=grip_name(i), active="false", **sites, **HARDNESS)
    actuator = _add(root, "actuator")
    for side in ("left", "right"):
        limits = _numbers(-body.MOTOR_TORQUE, body.MOTOR_TORQUE)
        _add(actuator, "velocity", name=side, joint=f"{side} wheel", kv=repr(MOTOR_GAIN), forcerange=limits)
    return tostring(root, encoding="unicode")


def solid_name(i: int) -> str:
    """Return the name of the geom of a wall or an obstacle."""
    return f"solid {i}"


def ball_name(i: int) -> str:
    """Return the name of the body and of the geom of a ball."""
    return f"ball {i}"


def grip_name(i: int) -> str:
    """Return the name of the constraint between gripper and ball, active only while the gripper holds it."""
    return f"grip {i}"


def _add_robot(world: Element, placement: Placement) -> None:
    x, y, heading = placement.robot
    turned = _numbers(math.cos(heading / 2), 0, 0, math.sin(heading / 2))
    robot = _add(world, "body", name="robot", pos=_numbers(x, y, body.MIDDLE_HEIGHT - SINK), quat=turned)
    _add(robot, "freejoint", name="robot")
    # The inertia is that of the box around body and paddles, as in Bullet.
    bottom = body.PADDLE_HEIGHT - body.PADDLE_HALF_SIDES[2]
    sides = (body.BODY_RADIUS + body.PADDLE_TIP, 2 * body.BODY_RADIUS, body.BODY_TOP - min(body.BODY_BOTTOM, bottom))
    _inertial(
        robot, body.BODY_MASS, *(body.BODY_MASS / 12 * (sum(s * s for s in sides) - side * side) for side in sides)
    )
    half_height = (body.BODY_TOP - body.BODY_BOTTOM) / 2
    _add(robot, "geom", name=BODY_GEOMS[0], type="cylinder", size=_numbers(body.BODY_RADIUS, half_height), **_UNPAIRED)
    paddle_x = body.PADDLE_TIP - body.PADDLE_HALF_SIDES[0]
    paddle_y = body.PADDLE_OPENING / 2 + body.PADDLE_HALF_SIDES[1]
    for name, side in zip(BODY_GEOMS[1:], (1, -1), strict=True):
        middle = _numbers(paddle_x, side * paddle_y, body.PADDLE_HEIGHT - body.MIDDLE_HEIGHT)
        _add(robot, "geom", name=name, type="box", pos=middle, size=_numbers(*body.PADDLE_HALF_SIDES), **_UNPAIRED)
    _add(robot, "site", name="grip", pos=_numbers(body.GRIP_AHEAD, 0, body.BALL_RADIUS - body.MIDDLE_HEIGHT))
    radius = body.WHEEL_RADIUS
    for name, side in (("left wheel", 1), ("right wheel", -1)):
        place = (0, side * body.AXLE_TRACK / 2, radius - body.MIDDLE_HEIGHT)
        wheel = _sphere(robot, name, place, radius, body.WHEEL_MASS)
        wheel.insert(0, Element("joint", name=name, type="hinge", axis="0 1 0"))
    radius = body.CASTER_RADIUS
    _sphere(robot, "caster", (-body.CASTER_BEHIND, 0, radius - body.MIDDLE_HEIGHT), radius, body.REAR_MASS)


def _add_ball(world: Element, name: str, x: float, y: float) -> None:
    ball = _sphere(world, name, (x, y, body.BALL_RADIUS - SINK), body.BALL_RADIUS, body.BALL_MASS)
    ball.insert(0, Element("freejoint", name=name))
    _add(ball, "site", name=name)


def _sphere(parent: Element, name: str, middle: tuple[float, float, float], radius: float, mass: float) -> Element:
    """Add a body that is a solid sphere."""
    built = _add(parent, "body", name=name, pos=_numbers(*middle))
    _inertial(built, mass, *[0.4 * mass * radius * radius] * 3)
    _add(built, "geom", name=name, type="sphere", size=_numbers(radius), **_UNPAIRED)
    return built


def _inertial(parent: Element, mass: float, *inertia: float) -> None:
    _add(parent, "inertial", pos="0 0 0", mass=repr(mass), diaginertia=_numbers(*inertia))


def _add_contacts(root: Element, n_solids: int, n_balls: int) -> None:
    contact = _add(root, "contact")

    def pair(one: str, other: str, friction: float, spinning: float = 0.0, rolling: float = 0.0) -> None:
        _add(
            contact,
            "pair",
            geom1=one,
            geom2=other,
            condim="6" if rolling else "3" if friction else "1",
            friction=_numbers(friction, friction, spinning, rolling, rolling),
            **HARDNESS,
        )

    pair("left wheel", "floor", body.TYRE_FRICTION)
    pair("right wheel", "floor", body.TYRE_FRICTION)
    pair("caster", "floor", body.CASTER_FRICTION)
    solids, balls = [solid_name(i) for i in range(n_solids)], [ball_name(i) for i in range(n_balls)]
    for one, other in product(BODY_GEOMS, solids):
        pair(one, other, body.BODY_FRICTION * body.SOLID_FRICTION)
    for ball in balls:
        pair(ball, "floor", body.BALL_FRICTION, body.BALL_SPINNING_FRICTION, body.BALL_ROLLING_FRICTION)
    for one, other in product(balls, BODY_GEOMS):
        pair(one, other, body.BALL_FRICTION * body.BODY_FRICTION)
    for one, other in product(balls, solids):
        pair(one, other, body.BALL_FRICTION * body.SOLID_FRICTION)
    for one, other in combinations(balls, 2):
        pair(one, other, body.BALL_FRICTION * body.BALL_FRICTION)


def _numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def _add(parent: Element, tag: str, **attributes: str) -> Element:
    return SubElement(parent, tag, attributes)
