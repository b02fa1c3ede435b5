"""Long runs: does memory grow?"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from experiments.common.seeds import Result
from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback

N_TIMESTEPS = 1_000_000
WARM_UP = 200_000
"""Primitive steps after which memory is to grow no more: buffers are full, and the last trajectories saved."""

GAMMA = 0.97
MAX_STEPS = 200
LONG = 500
"""Steps of an episode where a success comes by chance often enough for an option."""

N_KEPT = 20
"""Trajectories that discovery keeps, so that it keeps as many as it may when the warm-up is over."""


class Endless(gym.Wrapper[Any, Any, Any, Any]):
    """Begins anew at the start where an episode would end, so that none ever does."""

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The environment's, which never ends."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            observation, _ = self.env.reset()
        return observation, reward, False, False, info


def _endless() -> gym.Env[Any, Any]:
    return OptionsWrapper(Monitor(Endless(gym.make("sb3_options/TwoRooms-v0", max_steps=None))), 4, gamma=GAMMA)


def _room() -> gym.Env[Any, Any]:
    return OptionsWrapper(Monitor(gym.make("sb3_options/TwoRooms-v0", max_steps=MAX_STEPS)), 4, gamma=GAMMA)


def _callback(**more: Any) -> SubgoalDiscoveryCallback:
    settings = {"capacity": N_KEPT} | more.pop("settings", {})
    return SubgoalDiscoveryCallback(settings, **more)


def _fail(_: object) -> bool:
    return False


def _ppo(env: gym.Env[Any, Any], seed: int) -> BaseAlgorithm:
    return PPO("MlpPolicy", env, gamma=GAMMA, seed=seed, device="cpu")


def _one_epoch(env: gym.Env[Any, Any], seed: int) -> BaseAlgorithm:
    """PPO that learns from each rollout once, which takes a third of the time: gradient steps keep nothing."""
    return PPO("MlpPolicy", env, n_epochs=1, gamma=GAMMA, seed=seed, device="cpu")


def _dqn(env: gym.Env[Any, Any], seed: int) -> BaseAlgorithm:
    return DQN(
        "MlpPolicy",
        env,
        gamma=GAMMA,
        seed=seed,
        device="cpu",
        buffer_size=20_000,
        replay_buffer_class=OptionReplayBuffer,
    )


Make = Callable[[gym.Env[Any, Any], int], BaseAlgorithm]
CASES: dict[str, tuple[Make, Callable[[], gym.Env[Any, Any]], Callable[[], SubgoalDiscoveryCallback]]] = {
    "PPO, discovering": (_ppo, _room, _callback),
    "DQN, discovering": (_dqn, _room, _callback),
    "endless failures": (_ppo, _room, partial(_callback, success=_fail)),
    "one endless episode": (_one_epoch, _endless, partial(_callback, success=_fail)),
}


class Memory(BaseCallback):
    """Reads the memory of this process when the warm-up is over, and at the end."""

    def __init__(self, warm_up: int) -> None:
        super().__init__()
        self._warm_up = warm_up
        self.after_warm_up = self.at_end = 0.0

    def _on_step(self) -> bool:
        if not self.after_warm_up and self.num_timesteps >= self._warm_up:
            self.after_warm_up = resident()
        return True

    def _on_training_end(self) -> None:
        self.at_end = resident()


def resident() -> float:
    """Resident memory of this process, MB, after a garbage collection."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def run(name: str, n_timesteps: int, warm_up: int, seed: int) -> Result:
    """Train once.

    Args:
        name: Of `CASES`.
        n_timesteps: How long.
        warm_up: When memory is read first.
        seed: Of everything.

    Returns:
        What it was told; ``after_warm_up`` and ``at_end``, MB; ``growth``, their difference; ``episodes``,
        ``options``, ``seconds``.
    """
    make, env, callback = CASES[name]
    discovery, memory = callback(), Memory(warm_up)
    began = time.perf_counter()
    make(env(), seed).learn(n_timesteps, callback=[discovery, memory])
    return {
        "n_timesteps": n_timesteps,
        "warm_up": warm_up,
        "after_warm_up": memory.after_warm_up,
        "at_end": memory.at_end,
        "growth": memory.at_end - memory.after_warm_up,
        "episodes": discovery.episodes,
        "options": len(discovery.discoveries),
        "seconds": time.perf_counter() - began,
    }
