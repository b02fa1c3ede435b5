"""Small environments for SB3, a log of the primitive steps that happened, and what a replay buffer must make of it."""

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_options import Option, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs import GridWorld

SMALL_ROOMS = """
SSSS#....
SSSS#....
SSSS.....
SSSS#....
SSSS#...G
"""
DOORWAY = (4.0, 2.0)

# Versions of gymnasium differ in the versions of Taxi they still make.
TAXI = next(env_id for env_id in ("Taxi-v3", "Taxi-v4") if env_id in gym.registry)

FAST_DISCOVERY: dict[str, Any] = {"min_positive": 3, "start_radius": 0.5, "goal_radius": 3.0, "decay": 0.5}
"""Finds the doorway of `SMALL_ROOMS` within some ten episodes."""

RANDOM: dict[str, Any] = {"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0}

TINY: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [16]},
    "learning_starts": 100,
    "train_freq": 16,
    "batch_size": 16,
    "buffer_size": 5000,
    "seed": 0,
}


def small_rooms(**kwargs: Any) -> gym.Env[Any, Any]:
    """Two rooms of 4×5 cells with a doorway at (4, 2)."""
    return GridWorld(**{"map": SMALL_ROOMS, "max_steps": 150, **kwargs})


def optioned_rooms(max_options: int = 4, **kwargs: Any) -> OptionsWrapper:
    """The same with option slots."""
    return OptionsWrapper(small_rooms(**kwargs), max_options, gamma=0.9)


def make_optioned_rooms() -> gym.Env[Any, Any]:
    """What a worker process calls."""
    return optioned_rooms()


def fast_callback(**kwargs: Any) -> SubgoalDiscoveryCallback:
    """Finds the doorway of the small rooms early."""
    return SubgoalDiscoveryCallback(FAST_DISCOVERY, **{"max_new_options": 1, **kwargs})


def read_video(path: Path, height: int, width: int) -> npt.NDArray[np.uint8]:
    """Every picture of a video, (n, height, width, 3); imageio's own reader leaves pipes open, which warns."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    content = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(content, dtype=np.uint8).reshape(-1, height, width, 3)


def n_colours(picture: npt.NDArray[np.uint8]) -> int:
    """How many colours a picture has, (height, width, 3 or 4)."""
    channels = np.moveaxis(picture.astype(np.uint32), -1, 0)
    return len(np.unique(sum(channel << (8 * i) for i, channel in enumerate(channels))))


def env_of(model: BaseAlgorithm) -> VecEnv:
    """The model's environment, which it has."""
    venv = model.get_env()
    assert venv is not None
    return venv


class PrimitiveStep(NamedTuple):
    """One primitive step beneath the options."""

    state: Any
    action: int
    reward: float
    next_state: Any
    terminated: bool
    truncated: bool


class StepLog(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps every primitive step."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.log: list[PrimitiveStep] = []
        self._state: Any = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._state, info = self.env.reset(**kwargs)
        return self._state, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.log.append(PrimitiveStep(self._state, int(action), float(reward), observation, terminated, truncated))
        self._state = observation
        return observation, reward, terminated, truncated, info


class ActionLog(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps every augmented action; stands above the options."""

    returns_steps_unchanged = True

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.chosen: list[int] = []

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.chosen.append(int(action))
        return self.env.step(action)


class TableOption(NamedTuple):
    """An option as tables over discrete states, for `helpers.table_option` and for the oracle."""

    initiation: Sequence[bool]
    policy: Sequence[int]
    termination: Sequence[bool]
    max_duration: int


class Row(NamedTuple):
    """What a replay buffer must hold of one transition."""

    state: Any
    action: int
    reward: float
    discount: float
    next_state: Any
    terminal: bool


def expected_rows(
    steps: Sequence[PrimitiveStep],
    chosen: Sequence[int],
    options: dict[int, TableOption],
    n_primitive: int,
    gamma: float,
    *,
    macro_q: bool = True,
) -> list[Row]:
    """Works out from the primitive steps alone what SMDP Q-learning and Macro-Q have to learn from, in order."""
    rows: list[Row] = []
    at = 0
    for action in chosen:
        option = options.get(action - n_primitive)
        k = 1
        if option is not None:
            began_inside = option.initiation[steps[at].state]
            while True:
                step = steps[at + k - 1]
                assert step.action == option.policy[step.state]
                s = step.next_state
                over = step.terminated or step.truncated or option.termination[s] or not option.initiation[s]
                if over or not began_inside or k == option.max_duration:
                    break
                k += 1
        run = steps[at : at + k]
        at += k
        total = sum(gamma**i * step.reward for i, step in enumerate(run))
        stored = run[0].action if option is None else action
        rows.append(Row(run[0].state, stored, total, gamma**k, run[-1].next_state, run[-1].terminated))
        if option is not None and macro_q:
            rows += [Row(s.state, s.action, s.reward, gamma, s.next_state, s.terminated) for s in run]
    assert at == len(steps)
    return rows


class Corridor(gym.Env[Any, int]):
    """A walk on a line of 12 places, left 0 and right 1, in any kind of observation; the end is at the right."""

    LAST = 11

    def __init__(self, kind: str = "box", limit: int = 25) -> None:
        self.kind, self.limit = kind, limit
        self.action_space: Any = spaces.Discrete(2)
        box, discrete = spaces.Box(0.0, 11.0, (2,), np.float32), spaces.Discrete(12)
        image = spaces.Box(0, 255, (36, 40, 3), np.uint8)
        self.observation_space: Any = {
            "box": box,
            "discrete": discrete,
            "dict": spaces.Dict({"place": box, "picture": image}),
            "dict_discrete": spaces.Dict({"place": discrete, "twice": box}),
            "image": image,
        }[kind]
        self.place, self.time = 0, 0

    def see(self, place: int) -> Any:
        box = np.array([place, 2 * place], dtype=np.float32)
        image = np.full((36, 40, 3), place, dtype=np.uint8)
        image[:, :, 1] = 7
        image[0, 1, 2] = 9
        return {
            "box": box,
            "discrete": place,
            "dict": {"place": box, "picture": image},
            "dict_discrete": {"place": place, "twice": box},
            "image": image,
        }[self.kind]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.time = int(self.np_random.integers(4)), 0
        return self.see(self.place), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place = max(self.place + (1 if action == 1 else -1), 0)
        self.time += 1
        arrived = self.place == self.LAST
        return self.see(self.place), 0.25 * self.place - 1.0, arrived, self.time == self.limit and not arrived, {}


def places(observations: Any) -> npt.NDArray[np.float64]:
    """A feature map for every kind of `Corridor`: the place, shape (batch, 1)."""
    if isinstance(observations, dict):
        observations = observations["place"]
    values = np.asarray(observations, dtype=np.float64)
    return values.reshape(len(values), -1)[:, :1]


def place_condition(test: Callable[[npt.NDArray[np.float64]], Any]) -> Callable[[Any], Any]:
    """A function of the place as a function of a batch of observations."""
    return lambda observations: test(places(observations)[:, 0])


def corridor_option(**kwargs: Any) -> Option:
    """To the right from places 2 to 7 of any kind of `Corridor` until place 8."""
    functions: list[Callable[[Any], Any]] = [lambda p: (p >= 2) & (p < 8), np.ones_like, lambda p: p == 8]
    return Option(*(place_condition(function) for function in functions), **kwargs)
