"""The Pioneer: a simulated robot that finds a ball, grips it and leaves it close to a wall."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from operator import index
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, SupportsIndex, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.core import RenderFrame
from numpy.typing import NDArray

from sb3_options.envs.checks import batch, count, number, one_of, step_limit
from sb3_options.envs.pioneer import senses
from sb3_options.envs.pioneer.arena import Arena, Placement, Pose, Position
from sb3_options.envs.pioneer.body import BALL_RADIUS, CONTROL_RATE
from sb3_options.envs.pioneer.bullet_simulator import BulletSimulator
from sb3_options.envs.pioneer.robot import PioneerRobot
from sb3_options.envs.pioneer.simulator import Simulator

if TYPE_CHECKING:
    from sb3_options.envs.pioneer.drawing import Renderer


Deposit = Literal["wall", "corner"]
ObservationKind = Literal["sensors", "retina"]
RenderMode = Literal["human", "rgb_array", "rgb_array_list"]


class Motion(NamedTuple):
    """A primitive action: a distance ahead, m, or a turn to the left, rad."""

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
"""Three forward distances, two left and two right turns: McGovern & Barto (2001), §7."""

DEPOSIT_GAP = 0.2
"""A ball is close to a wall if its surface is this near, m."""

DEPOSIT_REWARD = 10.0
TOUCH_REWARD = -1.0
STEP_REWARD = -0.1
"""McGovern & Barto (2001), §7."""

TICKS_PER_PICTURE = 3
"""Control ticks between the pictures of render mode "rgb_array_list": ten a second."""

MAX_ARENA_SIZE = 100.0
"""m; balls taken away lie outside."""

MAX_STEPS = 500
"""Default step limit. A good policy needs a dozen steps."""

N_SONARS = len(senses.SONARS)
VISIBLE, DISPLACEMENT, WIDTH, GRIPPING = range(N_SONARS, N_SONARS + 4)
"""Their indices in the observation, after the sonars' ranges."""


class PioneerTask(gymnasium.Env[NDArray[np.float32], np.int64], ABC):
    """A Pioneer 2-DX in a walled arena finds a ball, grips it, and leaves it close to a wall.

    Actions 0..6 are the `ACTIONS`: forward by three distances, left by two angles, right by two angles. The gripper
    has no action. It closes by itself when a ball is between its paddles. It opens at the end of an action that began
    with the ball in it and ends with the ball in a place for deposits. The observation of that step still shows the
    ball in front of the open gripper; then the ball is taken away. An action ends when the robot, or the ball in its
    gripper, touches a wall or an obstacle. The robot then rolls back 5 cm and turns back to its earlier heading, so
    that it never gets stuck.

    Each step costs 0.1, a touch 1 more, and a deposited ball earns 10. An episode terminates when the last ball is
    deposited, and truncates after ``max_steps`` steps. The ``info`` of each step has

    - ``is_success``: whether this step deposited the last ball,
    - ``deposited``: whether it deposited a ball,
    - ``gripping``: whether there is a ball in the gripper,
    - ``touched_wall``: whether a wall or an obstacle was touched,
    - ``cause``: why the episode ended: ``"wall"`` or ``"corner"``, where the last ball was deposited, or
      ``"step limit"``; empty before the end.

    The observation is float32, of shape (11,):

    - 0..6: the sonars' ranges, m, from left to right; they look over the balls,
    - 7: whether a ball is visible, 0 or 1,
    - 8: its displacement, the bearing of the middle of its visible part, rad, positive to the left,
    - 9: its angular width, rad; width and displacement are 0 without a ball, and of two balls the wider counts,
    - 10: whether the gripper holds a ball, 0 or 1;

    with ``observation="retina"`` the retina's 70 pixels follow, from left to right, 1 where a ball is.

    The task, actions, senses and rewards follow McGovern & Barto (2001), §7. Subclasses choose the simulator: PyBullet
    in `Pioneer`, MuJoCo in `sb3_options.envs.pioneer.twin.PioneerMuJoCo`.

    Args:
        arena_size: Side of the square arena, m, at most ``MAX_ARENA_SIZE``.
        n_obstacles: Number of round obstacles.
        n_balls: Number of balls.
        deposit: Where a ball may be deposited: close to any wall, or only in the marked corner, the one with the
            largest x and y.
        max_steps: Steps after which an episode truncates; None for never.
        observation: Kind of observation.
        render_mode: ``"rgb_array"`` for one picture, ``"rgb_array_list"`` for all pictures since the last call, ten per
            second of motion, ``"human"`` for the simulator's own window, if it has one, in real time.

    Attributes:
        simulator: The simulator of the robot.
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
        max_steps: int | None = MAX_STEPS,
        observation: ObservationKind = "sensors",
        render_mode: RenderMode | None = None,
    ) -> None:
        self.simulator = self._make_simulator(window=render_mode == "human")
        self._arena = Arena(
            number(arena_size, "arena_size", low=0, high=MAX_ARENA_SIZE),
            count(n_obstacles, "n_obstacles", low=0),
            count(n_balls, "n_balls", low=1),
        )
        self._deposit = one_of(deposit, get_args(Deposit), "deposit")
        self._corner_only = self._deposit == "corner"
        self._max_steps = step_limit(max_steps)
        self._with_retina = one_of(observation, get_args(ObservationKind), "observation") == "retina"
        self.render_mode = (
            None if render_mode is None else one_of(render_mode, tuple(self.metadata["render_modes"]), "render_mode")
        )
        self.action_space = spaces.Discrete(len(ACTIONS))
        self.observation_space = _observation_space(self._with_retina)

        self._robot = PioneerRobot(self.simulator)
        self._senses = senses.Senses(self.simulator, can_hide=n_obstacles > 0)
        self._renderer: Renderer | None = None
        self._pictures: list[RenderFrame] = []
        self._ticks = 0
        if self.render_mode == "rgb_array_list":
            self.metadata = {**self.metadata, "render_fps": CONTROL_RATE // TICKS_PER_PICTURE}
            self._robot.on_tick = self._film
        elif self.render_mode == "human":
            self._robot.on_tick = _wait
        self._placement: Placement | None = None
        self._sensed = senses.Sensed([], [])
        self._deposited: list[Position] = []
        self._elapsed = 0
        self._over = False
        self._closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the environment's random generator; None leaves the generator as it is.
            options: Places of things, instead of random ones: ``"robot"`` is (x, y, heading) in m and rad, ``"balls"``
                and ``"obstacles"`` are lists of (x, y) in m. The origin is in the arena's middle.

        Returns:
            The first observation, and an empty info.
        """
        self._refuse_if_closed("reset")
        super().reset(seed=seed)
        self._placement = self._arena.sample(self.np_random, **self._arena.given(options or {}))
        self._robot.build(self._placement, self._arena.walls, self._arena.obstacles(self._placement))
        self._deposited = []
        self._elapsed = 0
        self._over = False
        observation = self._observe()
        if self.render_mode == "rgb_array_list":
            self._pictures = [self._picture(self._placement)]
        return observation, {}

    def step(self, action: SupportsIndex) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Carry out one of the `ACTIONS`.

        Args:
            action: 0..6.

        Returns:
            Observation, reward, terminated, truncated, and the info. A step that deposits the last ball is never
            truncated.
        """
        self._refuse_if_closed("step")
        if self._placement is None or self._over:
            when = "before the first reset()" if self._placement is None else "after the episode's end"
            raise gymnasium.error.ResetNeeded(f"step() was called {when}: call reset() first")
        try:
            chosen = index(action)
        except TypeError:
            chosen = -1
        if not 0 <= chosen < len(ACTIONS):
            raise gymnasium.error.InvalidAction(f"action must be an integer in 0..{len(ACTIONS) - 1}, got {action!r}")

        robot = self._robot
        carried = robot.held
        touched = robot.carry_out(*ACTIONS[chosen])
        deposited = carried is not None and self._may_deposit(robot.balls[carried])
        observation = self._observe()
        if deposited:
            self._deposited.append(robot.release())
            observation[GRIPPING] = 0
        if self.render_mode == "rgb_array_list":
            self._pictures.append(self._picture(self._placement))
        self._elapsed += 1
        terminated = deposited and not robot.balls
        truncated = self._elapsed == self._max_steps and not terminated
        self._over = terminated or truncated
        info = {
            "is_success": terminated,
            "deposited": deposited,
            "gripping": robot.held is not None,
            "touched_wall": touched,
            "cause": self._deposit if terminated else "step limit" if truncated else "",
        }
        reward = STEP_REWARD + TOUCH_REWARD * touched + DEPOSIT_REWARD * deposited
        return observation, reward, terminated, truncated, info

    @property
    def robot_pose(self) -> Pose:
        """x, y of the middle of the robot's axle, m, and the heading, rad, counter-clockwise from +x."""
        return self._robot.pose

    @property
    def ball_positions(self) -> dict[int, Position]:
        """x, y of the centre of each ball not yet deposited, m."""
        return dict(self._robot.balls)

    def concept_features(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Return the ball's place on the retina: the space in which the paper searches for subgoals.

        Args:
            observations: A batch of observations of this environment, shape ``(batch, *observation shape)``.

        Returns:
            Displacement and width, rad, shape (batch, 2); both are 0 if no ball is visible.
        """
        return batch(observations, self.observation_space)[:, [DISPLACEMENT, WIDTH]].astype(np.float64)

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        """Draw the arena from above; in render mode "human" the simulator has its own window.

        Returns:
            For ``"rgb_array"`` a uint8 picture of shape (544, 480, 3), for ``"rgb_array_list"`` a list of pictures,
            else None.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() does nothing without a render mode: pass render_mode='rgb_array'")
            return None
        self._refuse_if_closed("render")
        if self._placement is None:
            raise gymnasium.error.ResetNeeded("render() was called before the first reset(): call reset() first")
        if self.render_mode == "rgb_array":
            return self._picture(self._placement)
        pictures, self._pictures = self._pictures, []
        return pictures if self.render_mode == "rgb_array_list" else None

    def close(self) -> None:
        """Free the simulator; a second call does nothing."""
        self._closed = True
        self.simulator.close()

    @abstractmethod
    def _make_simulator(self, *, window: bool) -> Simulator:
        """Make this environment's own simulator, with or without a window."""

    def _observe(self) -> NDArray[np.float32]:
        robot = self._robot
        self._sensed = self._senses.look(robot.pose, robot.balls.values())
        ranges, seen = self._sensed
        ball = (1.0, seen[0].displacement, min(seen[0].width, senses.MAX_WIDTH)) if seen else (0.0, 0.0, 0.0)
        numbers = np.array((*ranges, *ball, robot.held is not None), dtype=np.float32)
        return np.concatenate((numbers, senses.retina(seen))) if self._with_retina else numbers

    def _film(self) -> None:
        """Take a picture every few ticks of an action."""
        self._ticks += 1
        if self._ticks % TICKS_PER_PICTURE == 0 and self._placement is not None:
            self._observe()
            self._pictures.append(self._picture(self._placement))

    def _picture(self, placement: Placement) -> NDArray[np.uint8]:
        # Imported late: training draws nothing.
        from sb3_options.envs.pioneer.drawing import Renderer, Scene

        if self._renderer is None:
            self._renderer = Renderer(self._arena.half, DEPOSIT_GAP + BALL_RADIUS, corner_only=self._corner_only)
        robot = self._robot
        scene = Scene(robot.pose, robot.balls.values(), self._deposited, robot.held is not None, self._sensed)
        return self._renderer.draw(placement, scene)

    def _may_deposit(self, ball: Position) -> bool:
        near_wall = self._arena.wall_gap(*ball) - BALL_RADIUS < DEPOSIT_GAP
        return near_wall and (not self._corner_only or self._arena.in_marked_corner(*ball))

    def _refuse_if_closed(self, method: str) -> None:
        if self._closed:
            raise gymnasium.error.ClosedEnvironmentError(f"{method}() was called after close(): make a new environment")


class Pioneer(PioneerTask):
    """The robot in PyBullet, which has wheels up to CPython 3.11. It takes the arguments of `PioneerTask`.

    Render mode ``"human"`` opens Bullet's own window.
    """

    simulator: BulletSimulator

    def _make_simulator(self, *, window: bool) -> BulletSimulator:
        return BulletSimulator(gui=window)


def _wait() -> None:
    """Wait, so that people can watch: Bullet simulates faster than a robot moves."""
    time.sleep(1 / CONTROL_RATE)


def _observation_space(with_retina: bool) -> spaces.Space[NDArray[np.float32]]:
    low = [senses.SONAR_MIN] * N_SONARS + [0, -senses.FIELD_OF_VIEW / 2, 0, 0]
    high = [senses.SONAR_MAX] * N_SONARS + [1, senses.FIELD_OF_VIEW / 2, senses.MAX_WIDTH, 1]
    if with_retina:
        low += [0] * senses.N_PIXELS
        high += [1] * senses.N_PIXELS
    space: spaces.Space[Any] = spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)
    return space
