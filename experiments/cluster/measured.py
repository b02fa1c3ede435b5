"""What is timed on one machine: environments in Ray actors and in worker processes, and the parts of what they cost."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from benchmarks.turns import take_turns
from experiments.common.machines import Machines, finished
from sb3_options.execution.ray_vec_env import RayVecEnv
from sb3_options.experience.observations import FloatArray

PIONEER = "sb3_options/Pioneer-v0"
WORKERS = "SubprocVecEnv"


class Turn(NamedTuple):
    """A turn of one contestant.

    Attributes:
        seconds: Of a step of all environments.
        call: Seconds of asking every actor for an attribute, which costs the environments nothing; of them
        busy: Processor seconds of this process.
        load: Processes that wanted a core, mean of the last minute.
    """

    seconds: float
    call: float
    busy: float
    load: float


class Nothing(gym.Env[Any, int]):
    """Costs nothing: a step is what it takes to ask for it. Observations are as large as the Pioneer's."""

    def __init__(self) -> None:
        with closing(gym.make(PIONEER)) as env:
            size = env.observation_space.shape
        self.observation_space: Any = spaces.Box(-1.0, 1.0, size, np.float32)
        self.action_space: Any = spaces.Discrete(4)
        self._seen = np.zeros(size or (1,), dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin."""
        super().reset(seed=seed)
        return self._seen, {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Nothing."""
        return self._seen, 0.0, False, False, {}


def pioneer() -> gym.Env[Any, Any]:
    """What a worker makes."""
    import sb3_options.envs  # noqa: F401  # registers it there

    return gym.make(PIONEER)


def made(make: Callable[[], gym.Env[Any, Any]], n_envs: int, actors: int | None, seed: int) -> VecEnv:
    """Environments in that many actors, or in worker processes, reset."""
    venv: VecEnv = SubprocVecEnv([make] * n_envs) if actors is None else RayVecEnv([make] * n_envs, actors)
    venv.seed(seed)
    venv.reset()
    return venv


def race(n_envs: int, actors: tuple[int, ...], rounds: int, steps: int, seed: int) -> dict[str, list[Turn]]:
    """Random actions in the Pioneer, in turns; all contestants take the same ones."""
    players = {WORKERS: made(pioneer, n_envs, None, seed)}
    players |= {str(n): made(pioneer, n_envs, n, seed) for n in actors}
    random = {name: np.random.default_rng(seed) for name in players}
    try:
        for name in players:
            _seconds(players[name], random[name], 10)  # filled caches
        return take_turns(
            list(players), lambda name: _turn(players[name], random[name], steps), rounds, description="Racing"
        )
    finally:
        for venv in players.values():
            venv.close()


def stepping(steps: int, seed: int) -> FloatArray:
    """Processor seconds of each of some steps of one Pioneer, resets included."""
    venv = DummyVecEnv([pioneer])
    venv.seed(seed)
    venv.reset()
    random, taken = np.random.default_rng(seed), []
    for _ in range(steps):
        action, began = random.integers(0, _n_actions(venv), 1), time.process_time()
        venv.step(action)
        taken.append(time.process_time() - began)
    venv.close()
    return np.array(taken)


def learning(n_envs: int, n_steps: int = 256, rollouts: int = 4) -> float:
    """Processor seconds that PPO takes for a step of one environment that costs nothing, its update included."""
    venv = make_vec_env(Nothing, n_envs)
    model = PPO("MlpPolicy", venv, n_steps=n_steps, batch_size=256, n_epochs=10, seed=0, device="cpu")
    model.learn(n_steps * n_envs)
    began = time.process_time()
    model.learn(rollouts * n_steps * n_envs)
    return (time.process_time() - began) / (rollouts * n_steps * n_envs)


def tasks(n: int, cluster: str | None) -> float:
    """Processor seconds that the driver of a study takes for a part that does nothing."""
    ended = finished([partial(int, 0)] * n, Machines(cluster=cluster))
    next(ended)  # the first starts the processes
    began = time.process_time()
    for _ in ended:
        pass
    return (time.process_time() - began) / (n - 1)


def _turn(venv: VecEnv, random: np.random.Generator, steps: int) -> Turn:
    seconds, began, before = _seconds(venv, random, steps), time.perf_counter(), time.process_time()
    for _ in range(steps):
        venv.get_attr("render_mode")
    call, busy = (time.perf_counter() - began) / steps, (time.process_time() - before) / steps
    return Turn(seconds, call, busy, os.getloadavg()[0])


def _seconds(venv: VecEnv, random: np.random.Generator, steps: int) -> float:
    n = _n_actions(venv)
    began = time.perf_counter()
    for _ in range(steps):
        venv.step(random.integers(0, n, venv.num_envs))
    return (time.perf_counter() - began) / steps


def _n_actions(venv: VecEnv) -> int:
    assert isinstance(venv.action_space, spaces.Discrete)
    return int(venv.action_space.n)
