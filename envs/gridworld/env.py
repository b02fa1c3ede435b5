"""Gridworlds with bottlenecks: rooms joined by doorways, and doors that need a key."""

from collections.abc import Sequence
from operator import index
from typing import Any, Literal, SupportsIndex, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.core import RenderFrame
from numpy.typing import NDArray

from sb3_options.envs.checks import batch, number, one_of, step_limit
from sb3_options.envs.gridworld import drawing
from sb3_options.envs.gridworld.grid_map import Cell, Direction, GridMap
from sb3_options.envs.gridworld.maps import TWO_ROOMS, TWO_ROOMS_MAX_STEPS
from sb3_options.envs.gridworld.observations import ImageView, OneHotView, View, XYView
from sb3_options.envs.gridworld.window import Window

ObservationKind = Literal["onehot", "xy", "image"]
RenderMode = Literal["human", "rgb_array"]

KEY_FEATURE_SCALE = 5.0
"""Distance in concept space between having the key and not having it, in cells.

Diverse density compares states by exp(−d²) with d in cells. At one cell, a state with the key would pass for the same
cell without it (e⁻¹). At five cells it does not (e⁻²⁵), and the gap is still no longer than a room.
"""

_N_DIRECTIONS = len(Direction)
_VIEWS: dict[str, type[View]] = {"onehot": OneHotView, "xy": XYView, "image": ImageView}


class GridWorld(gymnasium.Env[NDArray[Any], np.int64]):
    """An agent in a walled grid walks to a goal. On some maps it needs a key to get there.

    Actions 0..3 are the directions up, down, left, right (`Direction`). The agent moves in the chosen direction with
    probability ``success_probability``, else in a uniformly random one of the four. It stays where it is if a wall,
    the border or a locked door is in the way. An episode terminates when the agent enters the goal, and truncates
    after ``max_steps`` steps. The ``info`` of each step has ``is_success``, whether this step reached the goal. The
    agent picks up a key by entering its cell, and keeps it until the episode ends. A ``continuing`` task does not
    terminate: the step after reaching the goal leads to a start, whatever the action.

    Observations, for a map of ``n`` cells:

    - ``"onehot"``: float32 of shape (n,), index ``y * width + x`` of the agent's cell. With a key on the map (2n,),
      where the second half is used while the agent has the key.
    - ``"xy"``: float32 of shape (2,), column and row in cells. With a key on the map (3,), 1 for having the key.
    - ``"image"``: uint8 of shape (height, width, 3) in px, both sides at least 36 px, one colour per cell.

    The default dynamics, rewards and starts follow McGovern & Barto (2001), §3 and §6.1. The four rooms follow Sutton,
    Precup & Singh (1999).

    Args:
        map: One line per row of ``#`` wall, ``.`` floor, ``S`` start, ``G`` goal, ``K`` key, ``D`` door.
        goal: Goal cell (x, y) instead of the map's; x is the column and y the row, from the top left.
        starts: Start cells instead of the map's. An episode starts in one of them, chosen uniformly at random.
        success_probability: Probability of moving in the chosen direction, 0..1.
        goal_reward: Reward for the step that enters the goal.
        step_reward: Reward for every other step.
        max_steps: Steps after which an episode truncates; None for never.
        continuing: Whether the agent, after reaching the goal, continues from a start in the same episode.
            ``is_success`` then says whether the episode has reached the goal so far.
        observation: Kind of observation.
        render_mode: ``"rgb_array"`` for pictures, ``"human"`` for a matplotlib window.

    Attributes:
        goal: The goal cell.
        start_cells: The cells where episodes start.
        doorways: One-cell gaps in walls, row by row.
        keys: The cells that hold a key.
        doors: The cells that only an agent with a key can enter.
        walls: Which cells are walls, bool of shape (height, width), read-only.
        width: Number of columns.
        height: Number of rows.

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If an argument is out of its range, the map is malformed, or a start cannot reach the
            goal.
    """

    # Gymnasium declares it as an instance attribute, so it cannot be a ClassVar.
    metadata = {"render_modes": list(get_args(RenderMode)), "render_fps": 15}  # noqa: RUF012

    def __init__(
        self,
        map: str = TWO_ROOMS,
        *,
        goal: Cell | None = None,
        starts: Sequence[Cell] | None = None,
        success_probability: float = 0.9,
        goal_reward: float = 1.0,
        step_reward: float = 0.0,
        max_steps: int | None = TWO_ROOMS_MAX_STEPS,
        continuing: bool = False,
        observation: ObservationKind = "onehot",
        render_mode: RenderMode | None = None,
    ) -> None:
        self._grid = GridMap.parse(map, goal, starts)
        self._success_probability = number(success_probability, "success_probability", low=0, high=1)
        self._goal_reward = number(goal_reward, "goal_reward")
        self._step_reward = number(step_reward, "step_reward")
        self._max_steps = step_limit(max_steps)
        self._continuing = continuing
        self._view = _VIEWS[one_of(observation, get_args(ObservationKind), "observation")](self._grid)
        self.render_mode = None if render_mode is None else one_of(render_mode, get_args(RenderMode), "render_mode")

        self.goal: Cell = self._grid.goal
        self.start_cells: list[Cell] = list(self._grid.starts)
        self.doorways: list[Cell] = list(self._grid.doorways)
        self.keys: list[Cell] = sorted(self._grid.keys)
        self.doors: list[Cell] = sorted(self._grid.doors)
        self.walls: NDArray[np.bool_] = self._grid.walls
        self.width: int = self._grid.width
        self.height: int = self._grid.height

        self.action_space = spaces.Discrete(_N_DIRECTIONS)
        self.observation_space = self._view.space

        # Looked up once, because `step` is short enough for attribute look-ups to count.
        self._observe = self._view.observe
        self._successors = self._grid.successors
        self._start_states = [self._grid.state(cell) for cell in self.start_cells]
        self._is_goal = [self._grid.cell(state) == self.goal for state in range(self._grid.n_states)]
        self._scenes: dict[bool, NDArray[np.uint8]] = {}
        self._window: Window | None = None

        self._state: int | None = None
        self._elapsed = 0
        self._over = False
        self._reached = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the environment's random generator; None leaves the generator as it is.
            options: ``{"start": (x, y)}`` starts in that cell instead of a random one.

        Returns:
            The first observation, and an empty info.
        """
        super().reset(seed=seed)
        options = options or {}
        unknown = options.keys() - {"start"}
        if unknown:
            raise ValueError(f"options has the unknown key {unknown.pop()!r}: only 'start' is understood")
        if "start" in options:
            state = self._grid.start_state(options["start"], "options['start']")
        else:
            state = self._drawn_start()
        self._state = state
        self._elapsed = 0
        self._reached = False
        self._over = False
        if self.render_mode == "human":
            self.render()
        return self._observe(state), {}

    def step(self, action: SupportsIndex) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Move the agent by at most one cell.

        Args:
            action: A `Direction`, 0..3.

        Returns:
            Observation, reward, terminated, truncated, and an info with ``is_success``. A step that reaches
            the goal is never truncated.
        """
        state = self._state
        if state is None or self._over:
            when = "before the first reset()" if state is None else "after the episode's end"
            raise gymnasium.error.ResetNeeded(f"step() was called {when}: call reset() first")
        try:
            direction = index(action)
        except TypeError:
            direction = -1
        if not 0 <= direction < _N_DIRECTIONS:
            raise gymnasium.error.InvalidAction(f"action must be an integer in 0..3, got {action!r}")
        rng = self.np_random
        if rng.random() >= self._success_probability:
            direction = int(_N_DIRECTIONS * rng.random())  # uniform like rng.integers(4), in half its time
        # A step can begin at the goal only in a continuing task.
        self._state = state = self._drawn_start() if self._is_goal[state] else self._successors[direction][state]
        self._elapsed += 1
        at_goal = self._is_goal[state]
        self._reached |= at_goal
        terminated = at_goal and not self._continuing
        truncated = self._elapsed == self._max_steps and not terminated
        self._over = terminated or truncated
        if self.render_mode == "human":
            self.render()
        reward = self._goal_reward if at_goal else self._step_reward
        return self._observe(state), reward, terminated, truncated, {"is_success": self._reached}

    def get_state(self) -> dict[str, Any]:
        """Return the state of the episode, for a checkpoint, without the random generator."""
        return {"state": self._state, "elapsed": self._elapsed, "over": self._over, "reached": self._reached}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`, in an environment made with the same arguments."""
        self._state, self._elapsed = state["state"], state["elapsed"]
        self._over, self._reached = state["over"], state["reached"]

    def _drawn_start(self) -> int:
        return self._start_states[int(self.np_random.integers(len(self._start_states)))]

    def concept_features(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Return the agent's position in each observation: the space of the search for subgoals.

        Args:
            observations: A batch of observations of this environment, shape ``(batch, *observation shape)``, of
                any integer or floating dtype.

        Returns:
            Column and row in cells, of shape (batch, 2). With a key on the map the shape is (batch, 3). The third
            feature is `KEY_FEATURE_SCALE` if the agent has the key, else 0.
        """
        features = self._view.positions(batch(observations, self._view.space))
        features[:, 2:] *= KEY_FEATURE_SCALE
        return features

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        """Draw the current state; for ``"rgb_array"`` return a uint8 picture (32 * height, 32 * width, 3)."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() does nothing without a render mode: pass render_mode='rgb_array'")
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("render() was called before the first reset(): call reset() first")
        picture = self._picture(self._state)
        if self.render_mode == "rgb_array":
            return picture
        if self._window is None:
            self._window = Window("GridWorld")
        self._window.show(picture, seconds=1 / self.metadata["render_fps"])
        return None

    def close(self) -> None:
        """Close the window of render mode "human", if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _picture(self, state: int) -> NDArray[np.uint8]:
        has_key = state >= self._grid.n_cells
        if has_key not in self._scenes:
            self._scenes[has_key] = drawing.scene(self._grid, has_key)
        picture = self._scenes[has_key].copy()
        drawing.draw_agent(picture, self._grid.cell(state))
        return picture
