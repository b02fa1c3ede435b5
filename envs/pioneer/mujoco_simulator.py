"""The Pioneer in MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from sb3_options.envs.pioneer import body
from sb3_options.envs.pioneer.arena import Box, Cylinder, Placement, Pose, Position
from sb3_options.envs.pioneer.mjcf import BODY_GEOMS, SOLID_GROUP, ball_name, grip_name, mjcf, solid_name
from sb3_options.envs.pioneer.simulator import Point, Simulator
from sb3_options.extras import how_to_install

TICK = body.PHYSICS_RATE // body.CONTROL_RATE  # physics steps per controller tick
N_GROUPS = 6  # of MuJoCo's geoms
BALL_INERTIA = 0.4 * body.BALL_MASS * body.BALL_RADIUS**2  # kg m²


def load_mujoco() -> ModuleType:
    """Import MuJoCo, which only simulations need."""
    try:
        import mujoco
    except ImportError as error:
        raise gymnasium.error.DependencyNotInstalled(
            "PioneerMuJoCo-v0 needs MuJoCo, which cannot be imported: install it with "
            f"{how_to_install('mujoco')}: {error}"
        ) from error
    module: ModuleType = mujoco
    return module


class MuJoCoSimulator(Simulator):
    """A separate scene in MuJoCo. It is compiled for every episode, which takes about a millisecond.

    Attributes:
        model: MuJoCo's ``MjModel``; None before the first `build`.
        data: MuJoCo's ``MjData``; None before the first `build`.
    """

    def __init__(self) -> None:
        self._mujoco: Any = load_mujoco()
        self.model: Any = None
        self.data: Any = None
        self._rays_meet = np.zeros(N_GROUPS, dtype=np.uint8)
        self._rays_meet[SOLID_GROUP] = 1
        self._hit = np.zeros(1, dtype=np.int32)

    def build(self, placement: Placement, walls: Sequence[Box], obstacles: Sequence[Cylinder]) -> None:
        """As `Simulator.build`."""
        mujoco = self._mujoco
        self.model = model = mujoco.MjModel.from_xml_string(mjcf(placement, walls, obstacles))
        self.data = data = mujoco.MjData(model)
        n_balls, n_solids = len(placement.balls), len(walls) + len(obstacles)
        # A joint address is the index of a joint's numbers: 7 of a pose, or 6 of a velocity.
        self._ball_poses = [int(model.joint(ball_name(i)).qposadr[0]) for i in range(n_balls)]
        self._ball_velocities = [int(model.joint(ball_name(i)).dofadr[0]) for i in range(n_balls)]
        self._grips = [model.equality(grip_name(i)).id for i in range(n_balls)]
        self._solids = np.array([model.geom(solid_name(i)).id for i in range(n_solids)])
        self._ball_geoms = [model.geom(ball_name(i)).id for i in range(n_balls)]
        self._body_geoms = [model.geom(name).id for name in BODY_GEOMS]
        self._damp(0, body.BODY_DAMPING, body.BODY_MASS, model.body("robot").inertia)
        for i, first in enumerate(self._ball_velocities):
            self._damp(first, body.BALL_DAMPING, body.BALL_MASS, model.body(ball_name(i)).inertia)
        self._pose, self._wheels = data.qpos, data.ctrl
        mujoco.mj_forward(model, data)  # rays need the places of things

    def drive(self, left: float, right: float) -> Pose:
        """As `Simulator.drive`."""
        self._wheels[:] = left, right
        for first in self._ball_velocities:
            self._slow_down(first)
        self._mujoco.mj_step(self.model, self.data, TICK)
        x, y, _z, qw, _qx, _qy, qz = self._pose[:7].tolist()
        return x, y, 2 * math.atan2(qz, qw)

    def ball(self, ball: int) -> Position:
        """As `Simulator.ball`."""
        first = self._ball_poses[ball]
        x, y = self._pose[first : first + 2].tolist()
        return x, y

    def hold(self, ball: int) -> None:
        """As `Simulator.hold`."""
        self.data.eq_active[self._grips[ball]] = 1

    def take_away(self, ball: int) -> None:
        """As `Simulator.take_away`."""
        self.data.eq_active[self._grips[ball]] = 0
        pose, velocity = self._ball_poses[ball], self._ball_velocities[ball]
        self.data.qpos[pose : pose + 7] = (body.ASIDE + ball, body.ASIDE, body.BALL_RADIUS, 1, 0, 0, 0)
        self.data.qvel[velocity : velocity + 6] = 0

    def is_touching(self, held: int | None) -> bool:
        """As `Simulator.is_touching`."""
        geoms = self.data.contact.geom
        solid = np.isin(geoms, self._solids).any(axis=1)
        if not solid.any():
            return False
        mine = self._body_geoms if held is None else [*self._body_geoms, self._ball_geoms[held]]
        return bool(np.isin(geoms[solid], mine).any())

    def ray_fractions(self, starts: Sequence[Point], ends: Sequence[Point]) -> list[float]:
        """As `Simulator.ray_fractions`."""
        cast = self._mujoco.mj_ray
        model = self.model
        data = self.data
        groups = self._rays_meet
        hit = self._hit
        origins = np.array(starts, dtype=np.float64)
        # MuJoCo measures distance in lengths of the vector, which is a fraction; -1 without a hit.
        fractions = (
            cast(model, data, origin, way, groups, 1, -1, hit)
            for origin, way in zip(origins, np.array(ends) - origins, strict=True)
        )
        return [fraction if 0 <= fraction <= 1 else 1.0 for fraction in fractions]

    def close(self) -> None:
        """Forget the scene; a second call does nothing."""
        self.model = self.data = None

    def get_state(self) -> NDArray[np.float64]:
        """Return MuJoCo's integration state, on which the next steps depend."""
        state = np.empty(self._mujoco.mj_stateSize(self.model, self._kind), dtype=np.float64)
        self._mujoco.mj_getState(self.model, self.data, state, self._kind)
        return state

    def set_state(self, state: NDArray[np.float64]) -> None:
        """Continue from `get_state`, after building the same scene."""
        expected = self._mujoco.mj_stateSize(self.model, self._kind)
        if np.shape(state) != (expected,):
            raise ValueError(
                f"the state must have the shape ({expected},) for this scene, got {np.shape(state)}: make the "
                "environment with the arguments that it had"
            )
        self._mujoco.mj_setState(self.model, self.data, np.asarray(state, dtype=np.float64), self._kind)

    @property
    def _kind(self) -> int:
        return int(self._mujoco.mjtState.mjSTATE_INTEGRATION)

    def _slow_down(self, first: int) -> None:
        """Apply the part of a ball's damping that grows with its speed.

        Bullet damps multibodies by k (1 + |v|) v, in motion and rotation. MuJoCo's damping is linear.
        """
        vx, vy, vz, wx, wy, wz = self.data.qvel[first : first + 6].tolist()
        push = -body.BALL_DAMPING * body.BALL_MASS * math.sqrt(vx * vx + vy * vy + vz * vz)
        twist = -body.BALL_DAMPING * BALL_INERTIA * math.sqrt(wx * wx + wy * wy + wz * wz)
        self.data.qfrc_applied[first : first + 6] = push * vx, push * vy, push * vz, twist * wx, twist * wy, twist * wz

    def _damp(self, first: int, rate: float, mass: float, inertia: Sequence[float]) -> None:
        """Damp a free joint, whose velocities begin at ``first``, by a rate in 1/s."""
        self.model.dof_damping[first : first + 6] = rate * np.array([mass] * 3 + list(inertia))
