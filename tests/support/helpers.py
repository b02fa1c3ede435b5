"""Small environments, options and trajectories whose results can be worked out by hand."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_options.density.regions import Region
from sb3_options.experience.observations import Observations, batch_size, stack
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.options.option import Option

StepFunction = Callable[["CountingEnv", int], tuple[Any, float, bool, bool, dict[str, Any]]]


class CountingEnv(gym.Env[npt.NDArray[np.float64], int]):
    """Counts its steps: after t steps the observation is [t], and step t is rewarded with t.

    So an option that starts after s steps and lasts k returns (s+1) + γ(s+2) + … + γᵏ⁻¹(s+k). All actions do the same.
    ``step`` replaces all of this: (env, action) → what ``step`` returns; ``env.time`` has been counted up already.
    """

    HORIZON = 1000

    def __init__(
        self,
        n_actions: int = 2,
        *,
        terminate_at: int | None = None,
        truncate_at: int | None = None,
        step: StepFunction | None = None,
    ) -> None:
        self.action_space: Any = spaces.Discrete(n_actions)
        self.observation_space: Any = spaces.Box(0.0, float(self.HORIZON), (1,), np.float64)
        self.terminate_at, self.truncate_at, self._step = terminate_at, truncate_at, step
        self.time = 0
        self.actions: list[int] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.time = 0
        self.actions = []
        return np.zeros(1), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time += 1
        self.actions.append(action)
        if self._step is not None:
            return self._step(self, action)
        terminated, truncated = self.time == self.terminate_at, self.time == self.truncate_at
        return np.array([float(self.time)]), float(self.time), terminated, truncated, {"time": self.time}


def numbered(env: CountingEnv, n_states: int) -> gym.Env[Any, Any]:
    """The same with ``Discrete`` observations."""
    return gym.wrappers.TransformObservation(env, lambda seen: int(seen[0]), spaces.Discrete(n_states))


class TableEnv(gym.Env[int, int]):
    """A random finite MDP with ``Discrete`` observations: noisy successors, rewards, terminal states, a time limit."""

    def __init__(self, rng: np.random.Generator, n_states: int = 8, n_actions: int = 3) -> None:
        self.action_space: Any = spaces.Discrete(n_actions)
        self.observation_space: Any = spaces.Discrete(n_states)
        self.successors = rng.integers(n_states, size=(n_states, n_actions, 2))
        self.rewards = rng.normal(size=(n_states, n_actions))
        self.terminal = rng.random(n_states) < 0.1
        self.time_limit = int(rng.integers(1, 60))
        self.state, self.time = 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.state, self.time = int(self.np_random.integers(self.observation_space.n)), 0
        return self.state, {"time": 0}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        reward = float(self.rewards[self.state, action])
        self.state = int(self.successors[self.state, action, self.np_random.integers(2)])
        self.time += 1
        info = {"time": self.time, "action": action}
        return self.state, reward, bool(self.terminal[self.state]), self.time == self.time_limit, info


def table_option(*tables: npt.ArrayLike, max_duration: int = 100, name: str = "table") -> Option:
    """A hand-made option for observations that are numbers, from one entry of I, π and β per state."""

    def look_up(table: npt.NDArray[Any]) -> Callable[[Observations], npt.NDArray[Any]]:
        return lambda observations: table[np.asarray(observations).reshape(len(observations)).astype(np.int64)]

    return Option(*(look_up(np.asarray(t)) for t in tables), max_duration=max_duration, name=name)


def steady_option(action: int = 0, *, max_duration: int = 100, name: str = "steady") -> Option:
    """May start anywhere, always takes ``action``, ends by its longest duration only."""
    return Option(
        lambda obs: np.ones(batch_size(obs), dtype=bool),
        lambda obs: np.full(batch_size(obs), action),
        lambda obs: np.zeros(batch_size(obs)),
        max_duration=max_duration,
        name=name,
    )


def trajectory_of(
    observations: Sequence[Any],
    actions: Sequence[int] | None = None,
    *,
    rewards: Sequence[float] | None = None,
    terminated: bool = False,
    is_success: bool | None = None,
) -> Trajectory:
    """The trajectory through ``observations``; by default action 0 and reward 0 throughout."""
    keys = [tuple(np.asarray(o).ravel().tolist()) for o in observations]
    distinct = list(dict.fromkeys(keys))
    n_steps = len(observations) - 1
    return Trajectory(
        states=stack([observations[keys.index(key)] for key in distinct]),
        visits=np.array([distinct.index(key) for key in keys]),
        actions=np.array([0] * n_steps if actions is None else actions, dtype=np.int64),
        rewards=np.array([0.0] * n_steps if rewards is None else rewards),
        terminated=terminated,
        truncated=not terminated,
        is_success=is_success,
    )


def labelled(trajectory: Trajectory, *, success: bool = True) -> LabelledTrajectory:
    """With the flat observation for features."""
    states = np.asarray(trajectory.states, dtype=np.float64)
    return LabelledTrajectory(trajectory, states.reshape(len(states), -1), success)


def line(places: Sequence[float], actions: Sequence[int] | None = None, **kwargs: Any) -> LabelledTrajectory:
    """A labelled trajectory through places on a line, observations [place]."""
    return labelled(trajectory_of([np.array([float(p)]) for p in places], actions, **kwargs))


def ball(*centre: float, radius: float = 0.0) -> Region:
    """A region of one ball, all features in units of 1."""
    return Region(np.array([centre]), np.ones(len(centre)), radius)


def random_state(env: gym.Env[Any, Any]) -> Any:
    return env.unwrapped.np_random.bit_generator.state


def equal(left: Any, right: Any) -> bool:
    """Equality bit for bit, types included."""
    if type(left) is not type(right):
        return False
    if isinstance(left, dict):
        return list(left) == list(right) and all(equal(left[key], right[key]) for key in left)
    if isinstance(left, np.ndarray):
        return (left.dtype.str, left.shape, left.tobytes()) == (right.dtype.str, right.shape, right.tobytes())
    same: bool = left == right
    return same
