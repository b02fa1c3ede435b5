"""`VecGridWorld`: gridworlds that step together in numpy, as environments on an accelerator do.

Nothing can be asked of one environment alone, so that it shows what `OptionsVecEnv` needs of a `VecEnv`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.envs.gridworld.grid_map import GridMap
from sb3_options.envs.gridworld.observations import OneHotView

N_DIRECTIONS = 4


class VecGridWorld(VecEnv):
    """Many `GridWorld`s on one map without keys, in one array of states; arguments as there."""

    def __init__(
        self, map: str, num_envs: int, *, success_probability: float = 0.9, max_steps: int = 200, seed: int = 0
    ) -> None:
        grid = GridMap.parse(map)
        self._view = OneHotView(grid)
        self._rows = np.stack([self._view.observe(state) for state in range(grid.n_states)])
        self._successors = np.array(grid.successors)
        self._starts = np.array([grid.state(cell) for cell in grid.starts])
        self._goal = grid.state(grid.goal)
        self._success_probability = success_probability
        self._max_steps = max_steps
        self._random = np.random.default_rng(seed)
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._states = np.zeros(num_envs, dtype=np.int64)
        super().__init__(num_envs, self._view.space, spaces.Discrete(N_DIRECTIONS))

    def concept_features(self, observations: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Column and row, (batch, 2)."""
        return self._view.positions(observations)

    def reset(self) -> npt.NDArray[np.float32]:
        """Start all episodes."""
        self._elapsed[:] = 0
        self._states = self._random.choice(self._starts, self.num_envs)
        return self._rows[self._states]

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take note of the actions."""
        slips = self._random.random(self.num_envs) >= self._success_probability
        self._directions = np.where(slips, self._random.integers(N_DIRECTIONS, size=self.num_envs), actions)

    def step_wait(self) -> Any:
        """Move all agents; ended episodes start anew."""
        self._states = self._successors[self._directions, self._states]
        self._elapsed += 1
        reached = self._states == self._goal
        dones = reached | (self._elapsed == self._max_steps)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(dones)
        for env in ended.tolist():
            infos[env] = {
                "terminal_observation": self._rows[self._states[env]],
                "TimeLimit.truncated": not reached[env],
                "is_success": bool(reached[env]),
                "episode": {"r": float(reached[env]), "l": int(self._elapsed[env]), "t": 0.0},
            }
        if len(ended):
            self._elapsed[ended] = 0
            self._states[ended] = self._random.choice(self._starts, len(ended))
        return self._rows[self._states], reached.astype(np.float32), dones, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed all environments at once."""
        self._random = np.random.default_rng(seed)
        return [seed] * self.num_envs

    def close(self) -> None:
        """Nothing is held."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """There are no environments to ask, but none of them renders."""
        if attr_name == "render_mode":
            return [None] * self.num_envs
        raise AttributeError(attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """There are no environments to change."""
        raise AttributeError(attr_name)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """There are no environments to call."""
        raise AttributeError(method_name)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """There are no wrappers."""
        return [False] * self.num_envs
