"""The Pioneer in PyBullet: its body, made of Bullet's shapes, and the scene around it, in a client of its own."""

from __future__ import annotations

import ctypes.util
import math
import sys
import weakref
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import gymnasium

from sb3_options.envs.pioneer import body
from sb3_options.envs.pioneer.arena import Box, Cylinder, Placement, Pose, Position
from sb3_options.envs.pioneer.simulator import Point, Simulator
from sb3_options.extras import how_to_install

SOLVER_ITERATIONS = 10  # per physics step; Bullet's default is 50, but a robot on three wheels needs few

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

WHEELS = (0, 1)  # joints of the left and the right wheel
TORQUES = (body.MOTOR_TORQUE, body.MOTOR_TORQUE)


def load_pybullet() -> ModuleType:
    """Import PyBullet, which only simulations need."""
    try:
        import pybullet
    except ImportError as error:
        raise gymnasium.error.DependencyNotInstalled(
            "this environment needs PyBullet, which cannot be imported: install it with "
            f"{how_to_install('pioneer')}: {error}. "
            "PyBullet has wheels up to CPython 3.11; on a later Python pip builds it from source, which takes a "
            "compiler and many minutes. sb3_options/PioneerMuJoCo-v0 is the same robot in MuJoCo, which has wheels for "
            f"every Python: {how_to_install('mujoco')}"
        ) from error
    module: ModuleType = pybullet
    return module


class BulletSimulator(Simulator):
    """A separate physics client, which connects when the first scene is built.

    Every episode builds a new scene. So nothing that Bullet remembers (contacts, warm starts, the order of its pairs)
    depends on earlier simulation, and one seed gives one trajectory, bit for bit.

    Args:
        gui: Whether to open Bullet's own window.

    Attributes:
        p: The ``pybullet`` module.
        client: The number of the physics client; -1 without one.
    """

    def __init__(self, *, gui: bool = False) -> None:
        self.p: Any = load_pybullet()
        self.client = -1
        self._gui = gui
        # Visual shape of all bodies. Without a window it is a speck: invisible meshes of the bodies would take most of
        # the time of building a scene.
        self._looks = -1
        self._grips: list[int] = []
        self._balls: list[int] = []
        self._robot = self._solid = -1

    def build(self, placement: Placement, walls: Sequence[Box], obstacles: Sequence[Cylinder]) -> None:
        """As `Simulator.build`."""
        self._clear()
        self._add_floor()
        self._solid = self._add_solid(walls, obstacles)
        self._balls = [self._add_ball(x, y) for x, y in placement.balls]
        self._robot = self._add_robot(*placement.robot)
        self._grips = [self._add_grip(ball) for ball in self._balls]

    def drive(self, left: float, right: float) -> Pose:
        """As `Simulator.drive`."""
        p = self.p
        client = self.client
        robot = self._robot
        p.setJointMotorControlArray(
            robot, WHEELS, p.VELOCITY_CONTROL, targetVelocities=(left, right), forces=TORQUES, physicsClientId=client
        )
        p.stepSimulation(client)
        (x, y, _z), (_qx, _qy, qz, qw) = p.getBasePositionAndOrientation(robot, client)
        return x, y, 2 * math.atan2(qz, qw)

    def ball(self, ball: int) -> Position:
        """As `Simulator.ball`."""
        (x, y, _z), _ = self.p.getBasePositionAndOrientation(self._balls[ball], self.client)
        return x, y

    def hold(self, ball: int) -> None:
        """As `Simulator.hold`."""
        self._set_grip(self._grips[ball], body.GRIP_FORCE)

    def take_away(self, ball: int) -> None:
        """As `Simulator.take_away`."""
        self._set_grip(self._grips[ball], 0.0)
        place = (body.ASIDE + ball, body.ASIDE, body.BALL_RADIUS)
        number = self._balls[ball]
        self.p.resetBasePositionAndOrientation(number, place, (0, 0, 0, 1), physicsClientId=self.client)
        self.p.resetBaseVelocity(number, (0, 0, 0), (0, 0, 0), physicsClientId=self.client)

    def is_touching(self, held: int | None) -> bool:
        """As `Simulator.is_touching`."""
        contacts = self.p.getContactPoints(self._solid, physicsClientId=self.client)
        if not contacts:
            return False
        mine = {self._robot} if held is None else {self._robot, self._balls[held]}
        # In a contact, 2 is the other body's number and 8 the distance of the surfaces, m: Bullet also reports
        # neighbours that do not touch.
        return any(contact[2] in mine and contact[8] < body.CONTACT_GAP for contact in contacts)

    def ray_fractions(self, starts: Sequence[Point], ends: Sequence[Point]) -> list[float]:
        """As `Simulator.ray_fractions`."""
        hits = self.p.rayTestBatch(starts, ends, collisionFilterMask=SOLID, physicsClientId=self.client)
        return [hit[2] for hit in hits]

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self.client >= 0:
            self.client = -1
            self._disconnect()

    def _clear(self) -> None:
        """Remove all bodies; connect first if necessary."""
        if self.client < 0:
            self._connect()
        p, client = self.p, self.client
        p.resetSimulation(physicsClientId=client)
        p.setGravity(0, 0, -body.GRAVITY, physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=1 / body.CONTROL_RATE,
            numSubSteps=body.PHYSICS_RATE // body.CONTROL_RATE,
            numSolverIterations=SOLVER_ITERATIONS,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        if not self._gui:
            self._looks = int(p.createVisualShape(p.GEOM_BOX, halfExtents=(0.01, 0.01, 0.01), physicsClientId=client))

    def _add_floor(self) -> None:
        p, client = self.p, self.client
        shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        floor = p.createMultiBody(0, shape, self._looks, physicsClientId=client)
        # Bullet multiplies the frictions of touching bodies: with 1 here, the other body's holds.
        p.changeDynamics(floor, -1, lateralFriction=1, physicsClientId=client)
        self._set_filter(floor, -1, FLOOR, BALL | WHEEL)

    def _add_solid(self, boxes: Sequence[Box], cylinders: Sequence[Cylinder]) -> int:
        """Add walls and obstacles as one immovable body, and return its number."""
        p, client = self.p, self.client
        shape = p.createCollisionShapeArray(
            shapeTypes=[p.GEOM_BOX] * len(boxes) + [p.GEOM_CYLINDER] * len(cylinders),
            halfExtents=[box.half_sides for box in boxes] + [(0, 0, 0)] * len(cylinders),
            radii=[0] * len(boxes) + [cylinder.radius for cylinder in cylinders],
            lengths=[0] * len(boxes) + [cylinder.height for cylinder in cylinders],
            collisionFramePositions=[box.middle for box in boxes] + [cylinder.middle for cylinder in cylinders],
            physicsClientId=client,
        )
        solid = int(p.createMultiBody(0, shape, self._looks, physicsClientId=client))
        self._set_filter(solid, -1, SOLID, BALL | BODY | RAY)
        return solid

    def _add_ball(self, x: float, y: float) -> int:
        p, client = self.p, self.client
        radius = body.BALL_RADIUS
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=radius, physicsClientId=client)
        place = (x, y, radius)
        ball = int(p.createMultiBody(body.BALL_MASS, shape, self._looks, basePosition=place, physicsClientId=client))
        p.changeDynamics(ball, -1, **BALL_DYNAMICS, physicsClientId=client)
        self._set_filter(ball, -1, BALL, FLOOR | SOLID | BALL | BODY)
        return ball

    def _add_robot(self, x: float, y: float, heading: float) -> int:
        """Build the robot at a pose (m, rad), and return its number."""
        p, client = self.p, self.client
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
                self._looks,
                basePosition=(x, y, body.MIDDLE_HEIGHT),
                baseOrientation=(0, 0, math.sin(heading / 2), math.cos(heading / 2)),
                linkMasses=[body.WHEEL_MASS, body.WHEEL_MASS, body.REAR_MASS],
                linkCollisionShapeIndices=[wheel, wheel, caster],
                linkVisualShapeIndices=[self._looks] * 3,
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
            self._set_filter(robot, link, WHEEL, FLOOR)
        p.changeDynamics(robot, -1, lateralFriction=body.BODY_FRICTION, physicsClientId=client)
        self._set_filter(robot, -1, BODY, SOLID | BALL)
        return robot

    def _add_grip(self, ball: int) -> int:
        """Add a permanent joint between gripper and ball, which exerts force only while the gripper is closed."""
        grip = self.p.createConstraint(
            self._robot,
            -1,
            ball,
            -1,
            self.p.JOINT_POINT2POINT,
            (0, 0, 0),
            (body.GRIP_AHEAD, 0, body.BALL_RADIUS - body.MIDDLE_HEIGHT),
            (0, 0, 0),
            physicsClientId=self.client,
        )
        self._set_grip(grip, 0)
        return int(grip)

    def _set_grip(self, grip: int, force: float) -> None:
        self.p.changeConstraint(grip, maxForce=force, physicsClientId=self.client)

    def _set_filter(self, number: int, link: int, group: int, mask: int) -> None:
        """Put a link of a body (-1: its base) into a group, and let it collide only with the groups in the mask."""
        self.p.setCollisionFilterGroupMask(number, link, group, mask, physicsClientId=self.client)

    def _connect(self) -> None:
        p = self.p
        if self._gui and not _has_display():
            raise gymnasium.error.Error(
                "Bullet's window cannot be opened, there is no display: use render_mode='rgb_array', or set DISPLAY"
            )
        try:
            client = p.connect(p.GUI if self._gui else p.DIRECT)
        except p.error as error:
            raise gymnasium.error.Error(f"PyBullet did not connect: {error}") from error
        if client < 0:
            what = (
                "its window (is there a display?)" if self._gui else "another physics client: close some environments"
            )
            raise gymnasium.error.Error(f"PyBullet could not open {what}")
        self.client = int(client)
        # Also if somebody forgets to close: Bullet has a limited number of clients.
        self._disconnect = weakref.finalize(self, _disconnect, p, self.client)


def _disconnect(p: Any, client: int) -> None:
    if p.isConnected(client):
        p.disconnect(client)


def _has_display() -> bool:
    """Whether a window can be opened; without an X server Bullet would wait for ever."""
    if not sys.platform.startswith("linux"):
        return True
    library = ctypes.util.find_library("X11")
    if library is None:
        return False
    x11 = ctypes.CDLL(library)
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if not display:
        return False
    x11.XCloseDisplay(ctypes.c_void_p(display))
    return True
