"""What is run for every seed: training until the first success."""

from __future__ import annotations

import time
from typing import Any, Literal, TypeAlias, get_args

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from experiments.common.seeds import Result
from experiments.deep.agents import make_model
from experiments.deep.settings import GAMMA, DeepSettings
from experiments.first_success.chain import Chain
from sb3_options import OptionsWrapper
from sb3_options.callbacks import IntrinsicRewardCallback, SubgoalDiscoveryCallback

Arm: TypeAlias = Literal["stock", "discovery", "discovery, count bonus", "stock, count bonus"]
ARMS: tuple[Arm, ...] = get_args(Arm)

SETTINGS = DeepSettings()
N_TIMESTEPS = 20_000
"""A run without a success ends here."""

CHAINS = {"chain of 4 rooms": Chain(4, max_steps=150), "chain of 8 rooms": Chain(8, max_steps=300)}
ROOMS: dict[str, tuple[str, dict[str, Any]]] = {
    "TwoRooms": ("sb3_options/TwoRooms-v0", {"max_steps": 100}),
    "KeyDoor": ("sb3_options/KeyDoor-v0", {"max_steps": 150}),
}
TASKS = (*ROOMS, *CHAINS)
"""Episodes are so short that a random walk hardly ever reaches the goal in time."""


class FirstSuccess(BaseCallback):
    """Ends training at the first success.

    Attributes:
        at: Primitive steps until then; None before.
    """

    at: int | None = None

    def _on_step(self) -> bool:
        if any(info.get("is_success") for info in self.locals["infos"]):
            self.at = self.num_timesteps
        return self.at is None


def run(task: str, arm: Arm, seed: int) -> Result:
    """Train until the first success.

    Args:
        task: Of `TASKS`.
        arm: Of `ARMS`: stock PPO, or MaskablePPO with slots that `SubgoalDiscoveryCallback` may fill.
        seed: Of everything random.

    Returns:
        ``first_success``, in primitive steps of all eight environments, or None; ``seconds``.
    """
    discovers = arm.startswith("discovery")

    def make() -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = Monitor(_made(task))
        return OptionsWrapper(env, SETTINGS.max_options, gamma=GAMMA) if discovers else env

    venv = DummyVecEnv([make] * SETTINGS.n_envs)
    venv.seed(seed)
    model = make_model("ppo", venv, "options" if discovers else "stock", SETTINGS, seed)
    first = FirstSuccess()
    callbacks: list[BaseCallback] = [first]
    if discovers:
        callbacks.insert(0, SubgoalDiscoveryCallback(SETTINGS.discovery, SETTINGS.option))
    if arm.endswith("count bonus"):
        callbacks.insert(0, IntrinsicRewardCallback("counts", weight=SETTINGS.bonus_weight, seed=seed))
    began = time.perf_counter()
    model.learn(N_TIMESTEPS, callback=CallbackList(callbacks))
    return {"seed": seed, "first_success": first.at, "seconds": round(time.perf_counter() - began, 1)}


def _made(task: str) -> gym.Env[Any, Any]:
    if task in CHAINS:
        chain = CHAINS[task]
        return chain.task(chain.n_rooms)
    env_id, keywords = ROOMS[task]
    made: gym.Env[Any, Any] = gym.make(env_id, **keywords)
    return made
