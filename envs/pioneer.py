"""The Pioneer: a simulated robot that finds a ball, grips it and leaves it close to a wall."""

from __future__ import annotations

import math
from operator import index
from typing import Any, Literal, NamedTuple, SupportsIndex, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.core import RenderFrame
from numpy.typing import NDArray

from sb3_options.envs.arena import BALL_RADIUS, Arena, Layout
from sb3_options.envs.bullet import Bullet
from sb3_options.envs.pioneer_robot import CONTROL_RATE, PHYSICS_RATE, SOLVER_ITERATIONS, PioneerRobot
from sb3_options.envs.pioneer_senses import (
    FIELD_OF_VIEW,
    MAX_WIDTH,
    N_PIXELS,
    SONAR_MAX,
    SONAR_MIN,
    SONARS,
    Sensed,
    Senses,
    retina,
)

__all__ = ["ACTIONS", "Deposit", "Motion", "ObservationKind", "Pioneer", "RenderMode"]

Deposit = Literal["wall", "corner"]
ObservationKind = Literal["sensors", "retina"]
RenderMode = Literal["human", "rgb_array"]


class Motion(NamedTuple):
    """A primitive action.

    Attributes:
        distance: m ahead.
        turn: rad to the left.
    """

    distance: float = 0.0
    turn: float = 0.0


ACTIONS = (
    Motion(distance=0.1),
    Motion(distance=0.25),
    Motion(distance=0.6),
    Motion(turn=math.radians(10)),
    Motion(turn=math.radians(45)),
    Motion(turn=math.radians(-10)),
    Motion(turn=math.radians(-45)),
)
"""Three distances forward, two left and two right rotations: McGovern & Barto (2001), §7."""

DEPOSIT_GAP = 0.2
"""A ball is close to a wall if its surface is this near, m."""

DEPOSIT_REWARD, TOUCH_REWARD, STEP_REWARD = 10.0, -1.0, -0.1
"""McGovern & Barto (2001), §7."""

N_SONARS = len(SONARS)
VISIBLE, DISPLACEMENT, WIDTH, GRIPPING = range(N_SONARS, N_SONARS + 4)
"""Where the observation has them, after the sonars' ranges."""


class Pioneer(gymnasium.Env[NDArray[np.float32], np.int64]):
    """A Pioneer 2-DX in a walled arena finds a ball, grips it, and leaves it close to a wall.

    Actions 0..6 are the `ACTIONS`: forward by three distances, left by two angles, right by two angles. The gripper
    has no action: it closes by itself when a ball is between its paddles, and opens at the end of an action that
    began with the ball in it and ends with the ball where it may be deposited. The ball is then taken away. An action
    that touches a wall or an obstacle, with the robot or with the ball in the gripper, ends there: the robot backs off
    by 5 cm, or turns back to where it looked.

    Each step costs 0.1, a touch 1 more, and a deposited ball earns 10. An episode terminates when the last ball is
    deposited, and truncates after ``max_steps`` steps. The ``info`` of each step says

    - ``is_success``: whether the last ball was deposited with it,
    - ``deposited``: whether a ball was,
    - ``gripping``: whether there is a ball in the gripper,
    - ``touched_wall``: whether a wall or an obstacle was touched.

    The observation is float32, of shape (11,):

    - 0..6: the sonars' ranges, m, from left to right; they look over the balls,
    - 7: whether a ball is to be seen, 0 or 1,
    - 8: its displacement, the bearing of the middle of what is seen of it, rad, positive to the left,
    - 9: its width, the angle it takes up, rad; with displacement 0 where there is none, and of two balls the wider,
    - 10: whether the gripper holds a ball, 0 or 1;

    with ``observation="retina"`` the retina's 70 pixels follow, from left to right, 1 where a ball is.

    The task, actions, senses and rewards are those of McGovern & Barto (2001), §7.

    Args:
        arena_size: Side of the square arena, m.
        n_obstacles: Round posts in it.
        n_balls: Balls in it.
        deposit: Where a ball may be deposited: close to any wall, or in the marked corner only, the one of largest x
            and y.
        max_steps: Steps after which an episode truncates; None for never.
        observation: What the agent senses.
        render_mode: ``"rgb_array"`` for pictures, ``"human"`` for Bullet's own window.

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If an argument is out of its range, or the arena has no room for robot, balls and obstacles.
        gymnasium.error.DependencyNotInstalled: If PyBullet is not installed.
    """

    # Gymnasium declares it as an instance attribute, so it cannot be a ClassVar.
    metadata = {"render_modes": list(get_args(RenderMode)), "render_fps": 5}  # noqa: RUF012

    def __init__(
        self,
        *,
        arena_size: float = 4.0,
        n_obstacles: int = 0,
        n_balls: int = 1,
        deposit: Deposit = "wall",
        max_steps: int | None = 500,
        observation: ObservationKind = "sensors",
        render_mode: RenderMode | None = None,
    ) -> None:
        self.arena = Arena(arena_size, n_obstacles, n_balls)
        self._deposit = deposit
        self._max_steps = max_steps
        self._with_retina = observation == "retina"
        self.render_mode = render_mode
        self.action_space = spaces.Discrete(len(ACTIONS))
        self.observation_space = _observation_space(self._with_retina)
        self._bullet = Bullet(
            1 / CONTROL_RATE, PHYSICS_RATE // CONTROL_RATE, SOLVER_ITERATIONS, gui=render_mode == "human"
        )
        self._robot = PioneerRobot(self._bullet)
        self._senses = Senses(self._bullet, can_hide=n_obstacles > 0)
        self._layout: Layout | None = None
        self._elapsed = 0
        self._over = False
        self._closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self._layout = self._chosen(options or {}, self.arena.sample(self.np_random))
        self._robot.build(self._layout, self.arena.walls, self.arena.posts(self._layout))
        self._elapsed = 0
        self._over = False
        return self._observe(), {}

    def step(self, action: SupportsIndex) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        motion = ACTIONS[self._checked(action)]
        robot = self._robot
        held = robot.held
        touched = robot.carry_out(*motion)
        observation = self._observe()
        deposited = held is not None and self._may_deposit(*robot.balls[held])
        if deposited:
            robot.release()
            observation[GRIPPING] = 0
        self._elapsed += 1
        terminated = deposited and not robot.balls
        truncated = self._elapsed == self._max_steps and not terminated
        self._over = terminated or truncated
        reward = STEP_REWARD + TOUCH_REWARD * touched + DEPOSIT_REWARD * deposited
        info = {
            "is_success": terminated,
            "deposited": deposited,
            "gripping": robot.held is not None,
            "touched_wall": touched,
        }
        return observation, reward, terminated, truncated, info

    def concept_features(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Where the ball is on the retina: the space in which the paper looks for subgoals.

        Args:
            observations: A batch of observations of this environment, shape (batch, *observation shape).

        Returns:
            Displacement and width, rad, shape (batch, 2); both are 0 where no ball is to be seen.

        Raises:
            ValueError: If the shape is wrong.
        """
        observations = np.asarray(observations)
        expected = self.observation_space.shape
        if observations.ndim == 0 or observations.shape[1:] != expected:
            raise ValueError(
                f"observations must be a batch of observations of shape {expected} each, got shape {observations.shape}"
            )
        return observations[:, [DISPLACEMENT, WIDTH]].astype(np.float64)

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        return None

    def close(self) -> None:
        self._closed = True
        self._bullet.close()

    def _observe(self) -> NDArray[np.float32]:
        robot = self._robot
        self._sensed = sensed = self._senses.look(robot.pose, robot.balls.values())
        seen = sensed.sightings
        ball = (1.0, seen[0].displacement, min(seen[0].width, MAX_WIDTH)) if seen else (0.0, 0.0, 0.0)
        numbers = np.array((*sensed.ranges, *ball, robot.held is not None), dtype=np.float32)
        return np.concatenate((numbers, retina(seen))) if self._with_retina else numbers

    def _may_deposit(self, x: float, y: float) -> bool:
        close = self.arena.wall_gap(x, y) - BALL_RADIUS < DEPOSIT_GAP
        return close and (self._deposit == "wall" or self.arena.in_marked_corner(x, y))

    def _chosen(self, options: dict[str, Any], layout: Layout) -> Layout:
        unknown = options.keys() - set(Layout._fields)
        if unknown:
            raise ValueError(f"options has the unknown key {unknown.pop()!r}")
        return self.arena.check(layout._replace(**options)) if options else layout

    def _checked(self, action: SupportsIndex) -> int:
        if self._closed:
            raise gymnasium.error.ClosedEnvironmentError("step() was called after close(): make a new environment")
        if self._layout is None or self._over:
            when = "before the first reset()" if self._layout is None else "after the episode's end"
            raise gymnasium.error.ResetNeeded(f"step() was called {when}: call reset() first")
        try:
            number = index(action)
        except TypeError:
            number = -1
        if not 0 <= number < len(ACTIONS):
            raise gymnasium.error.InvalidAction(f"action must be an integer in 0..{len(ACTIONS) - 1}, got {action!r}")
        return number


def _observation_space(with_retina: bool) -> spaces.Box:
    low = [SONAR_MIN] * N_SONARS + [0, -FIELD_OF_VIEW / 2, 0, 0]
    high = [SONAR_MAX] * N_SONARS + [1, FIELD_OF_VIEW / 2, MAX_WIDTH, 1]
    if with_retina:
        low += [0] * N_PIXELS
        high += [1] * N_PIXELS
    return spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32), dtype=np.float32)
