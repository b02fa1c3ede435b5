"""What is run for every seed: an algorithm on MiniGrid, with and without slots that stay empty."""

from __future__ import annotations

import time
from typing import Any, Literal

import gymnasium as gym
import minigrid  # noqa: F401  # registers its environments
import numpy as np
from minigrid.wrappers import FlatObsWrapper
from sb3_contrib import MaskablePPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from experiments.common.seeds import Result
from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback

Arm = Literal["stock", "callback", "no callback"]
ARMS: tuple[Arm, ...] = ("stock", "callback", "no callback")
TASKS = {"PPO": "MiniGrid-DoorKey-5x5-v0", "DQN": "MiniGrid-Empty-5x5-v0", "MaskablePPO": "MiniGrid-DoorKey-5x5-v0"}
"""DQN never opens a door within these steps; without one it is between all and nothing."""
N_TIMESTEPS = {"PPO": 30_000, "MaskablePPO": 30_000, "DQN": 15_000}
GAMMA = 0.99
N_SLOTS = 4
LAST_EPISODES = 100


class Returns(BaseCallback):
    """Keeps the return of every episode."""

    def __init__(self) -> None:
        super().__init__()
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if episode := info.get("episode"):
                self.returns.append(float(episode["r"]))
        return True


def run(algorithm: str, arm: Arm, seed: int) -> Result:
    """Train once.

    Args:
        algorithm: A key of `TASKS`, which names its task.
        arm: ``stock``: SB3 alone. ``callback``: four slots that stay empty, and `PrimitiveStepsCallback`, which a
            `SubgoalDiscoveryCallback` that discovers nothing equals. ``no callback``: the slots alone.
        seed: Of model, environment and discovery.

    Returns:
        ``final_return``: mean of the last episodes; ``mean_return``: of all; ``n_episodes``; ``seconds``.
    """
    env: gym.Env[Any, Any] = Monitor(FlatObsWrapper(gym.make(TASKS[algorithm])))
    if arm != "stock":
        env = OptionsWrapper(env, max_options=N_SLOTS, gamma=GAMMA)
    elif algorithm == "MaskablePPO":
        env = ActionMasker(env, lambda masked: np.ones(masked.action_space.n, dtype=bool))  # type: ignore[attr-defined]
    returns = Returns()
    callbacks: list[BaseCallback] = [returns]
    if arm == "callback":
        callbacks.append(PrimitiveStepsCallback())
    began = time.perf_counter()
    _model(algorithm, arm, env, seed).learn(N_TIMESTEPS[algorithm], callback=callbacks)
    return {
        "seed": seed,
        "final_return": float(np.mean(returns.returns[-LAST_EPISODES:] or [0.0])),
        "mean_return": float(np.mean(returns.returns or [0.0])),
        "n_episodes": len(returns.returns),
        "seconds": time.perf_counter() - began,
    }


def _model(algorithm: str, arm: Arm, env: gym.Env[Any, Any], seed: int) -> BaseAlgorithm:
    if algorithm == "PPO":
        return PPO("MlpPolicy", env, gamma=GAMMA, seed=seed, device="cpu")
    if algorithm == "MaskablePPO":
        return MaskablePPO("MlpPolicy", env, gamma=GAMMA, seed=seed, device="cpu")
    buffer = None if arm == "stock" else OptionReplayBuffer
    return DQN("MlpPolicy", env, gamma=GAMMA, seed=seed, device="cpu", replay_buffer_class=buffer, buffer_size=30_000)
