"""A thin layer over PyBullet: one physics client, the bodies of a scene, and the few calls of a step."""

from __future__ import annotations

import ctypes.util
import sys
import weakref
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import gymnasium

from sb3_options.envs.pioneer.arena import Box, Cylinder
from sb3_options.envs.pioneer.body import GRAVITY
from sb3_options.extras import how_to_install

Point = Sequence[float]


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


class Bullet:
    """A separate physics client, which connects when the first scene is built.

    Every episode builds a new scene. So nothing that Bullet remembers (contacts, warm starts, the order of its pairs)
    depends on earlier simulation, and one seed gives one trajectory, bit for bit.

    Args:
        tick: Simulated time of one call of ``stepSimulation``, s.
        substeps: Physics steps per tick.
        solver_iterations: Iterations of the constraint solver per physics step.
        gui: Whether to open Bullet's own window.

    Attributes:
        p: The ``pybullet`` module.
        client: The number of the physics client; -1 without one.
        looks: Number of the visual shape of bodies. Without a window it is a speck: invisible meshes of the bodies
            would take most of the time of building a scene.
    """

    def __init__(self, tick: float, substeps: int, solver_iterations: int, *, gui: bool = False) -> None:
        self.p: Any = load_pybullet()
        self.client = -1
        self.looks = -1
        self._tick = tick
        self._substeps = substeps
        self._solver_iterations = solver_iterations
        self._gui = gui

    def clear(self) -> None:
        """Remove all bodies; connect first if necessary."""
        if self.client < 0:
            self._connect()
        p, client = self.p, self.client
        p.resetSimulation(physicsClientId=client)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=self._tick,
            numSubSteps=self._substeps,
            numSolverIterations=self._solver_iterations,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        if not self._gui:
            self.looks = int(p.createVisualShape(p.GEOM_BOX, halfExtents=(0.01, 0.01, 0.01), physicsClientId=client))

    def add_static(self, boxes: Sequence[Box], cylinders: Sequence[Cylinder]) -> int:
        """Add boxes and cylinders as one immovable body, and return its number."""
        p, client = self.p, self.client
        shape = p.createCollisionShapeArray(
            shapeTypes=[p.GEOM_BOX] * len(boxes) + [p.GEOM_CYLINDER] * len(cylinders),
            halfExtents=[box.half_sides for box in boxes] + [(0, 0, 0)] * len(cylinders),
            radii=[0] * len(boxes) + [cylinder.radius for cylinder in cylinders],
            lengths=[0] * len(boxes) + [cylinder.height for cylinder in cylinders],
            collisionFramePositions=[box.middle for box in boxes] + [cylinder.middle for cylinder in cylinders],
            physicsClientId=client,
        )
        return int(p.createMultiBody(0, shape, self.looks, physicsClientId=client))

    def add_floor(self) -> int:
        """Add the plane z = 0, and return its number."""
        shape = self.p.createCollisionShape(self.p.GEOM_PLANE, physicsClientId=self.client)
        floor = int(self.p.createMultiBody(0, shape, self.looks, physicsClientId=self.client))
        # Bullet multiplies the frictions of touching bodies: with 1 here, the other body's holds.
        self.p.changeDynamics(floor, -1, lateralFriction=1, physicsClientId=self.client)
        return floor

    def add_ball(self, mass: float, radius: float, x: float, y: float, **dynamics: float) -> int:
        """Add a ball on the floor, and return its number."""
        p, client = self.p, self.client
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=radius, physicsClientId=client)
        ball = int(p.createMultiBody(mass, shape, self.looks, basePosition=(x, y, radius), physicsClientId=client))
        p.changeDynamics(ball, -1, **dynamics, physicsClientId=client)
        return ball

    def set_filter(self, body: int, link: int, group: int, mask: int) -> None:
        """Put a link (-1: the base) into a group, and let it collide only with the groups in the mask."""
        self.p.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=self.client)

    def position(self, body: int) -> tuple[float, float, float]:
        """Return the position of a body, m."""
        position: tuple[float, float, float] = self.p.getBasePositionAndOrientation(body, physicsClientId=self.client)[
            0
        ]
        return position

    def place(self, body: int, x: float, y: float, z: float) -> None:
        """Put a body at a position, m, upright and at rest."""
        self.p.resetBasePositionAndOrientation(body, (x, y, z), (0, 0, 0, 1), physicsClientId=self.client)
        self.p.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0), physicsClientId=self.client)

    def ray_fractions(self, starts: Sequence[Point], ends: Sequence[Point], mask: int) -> list[float]:
        """Return how far along each ray the first hit is, 0..1; 1 without a hit."""
        hits = self.p.rayTestBatch(starts, ends, collisionFilterMask=mask, physicsClientId=self.client)
        return [hit[2] for hit in hits]

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self.client >= 0:
            self.client = -1
            self._disconnect()

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
