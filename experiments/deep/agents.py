"""The agents: environments and models with or without options, and how they are evaluated."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from sb3_contrib import QRDQN, MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from experiments.common.playing import greedy_episodes
from experiments.deep.arms import N_STEP, OPTIONS, STOCK, Arm
from experiments.deep.repeats import RandomRepeat
from experiments.deep.settings import GAMMA, DeepSettings, family
from experiments.deep.tasks import Task
from sb3_options import OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.experience.success import learned_at

ALGORITHMS: dict[str, tuple[Any, Any]] = {
    "dqn": (DQN, OptionDQN),
    "ppo": (PPO, MaskablePPO),
    "dqn-unmasked": (DQN, DQN),
    "ppo-unmasked": (PPO, PPO),
    "qrdqn": (QRDQN, QRDQN),
}
"""Stock, and with options: where there is one, the variant that keeps to the options' initiation sets."""

REPEAT_SEED = 700_000
"""Mixed into the seed of the random repeats, so that their draws are apart from the environment's."""

REACHED = 0.9
"""The success rate that a run has to reach, in two evaluations in a row: one alone may be luck."""


def make_env(task: Task, algo: str, arm: Arm, settings: DeepSettings, seed: int, n_envs: int, **kwargs: Any) -> VecEnv:
    """The target's environments, with option slots unless it is the stock arm."""

    def make(i: int) -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = Monitor(gym.make(task.env, **{**task.target, **kwargs}))
        if arm in STOCK:
            return env
        max_runs = settings.max_runs[family(algo)] if arm in OPTIONS else 0
        optioned = OptionsWrapper(env, settings.max_options, gamma=GAMMA, max_runs=max_runs or None)
        if arm == "repeats":
            rng = np.random.default_rng([seed + i, REPEAT_SEED])
            for action in range(optioned.n_primitive):
                optioned.bank.add(RandomRepeat(action, rng))
        return optioned

    venv = DummyVecEnv([lambda i=i: make(i) for i in range(n_envs)])  # type: ignore[misc]  # bound early
    venv.seed(seed)
    return venv


def make_model(algo: str, venv: VecEnv, arm: Arm, settings: DeepSettings, seed: int) -> BaseAlgorithm:
    """The untrained model."""
    stock, with_options = ALGORITHMS[algo]
    common: dict[str, Any] = {"gamma": GAMMA, "seed": seed, "device": "cpu"}
    own = settings.arguments(algo, arm)
    if issubclass(stock, OffPolicyAlgorithm):
        n_steps = {"n_steps": settings.n_steps} if arm in N_STEP else {}
        if arm in STOCK:
            own = {**own, **n_steps}
        else:  # SB3 hands its own argument to its own buffers only
            own = {**own, "replay_buffer_class": OptionReplayBuffer, "replay_buffer_kwargs": n_steps}
    made: BaseAlgorithm = (stock if arm in STOCK else with_options)("MlpPolicy", venv, **common, **own)
    return made


class Evaluations(BaseCallback):
    """Acts greedily in environments of its own, every so many primitive steps.

    Args:
        venv: One environment per episode, cut off where an episode counts as failed.
        every: Primitive steps.
        steps_after: Training ends this many primitive steps after `reached_at`.
        seed: Every evaluation sees the same episodes.

    Attributes:
        points: Primitive steps, success rate and mean length of each evaluation.
        seconds: Of training before each of them, without the evaluations.
    """

    def __init__(self, venv: VecEnv, every: int, steps_after: int, seed: int) -> None:
        super().__init__()
        self.venv, self.every, self.steps_after, self.seed = venv, every, steps_after, seed
        self.points: list[tuple[int, float, float]] = []
        self.seconds: list[float] = []
        self._next = 0

    def _on_training_start(self) -> None:
        self._began = time.perf_counter()

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            paused = time.perf_counter()
            self.seconds.append(round(paused - self._began, 3))
            self._next = (self.num_timesteps // self.every + 1) * self.every
            self.points.append((self.num_timesteps, *greedy(self.model, self.venv, self.seed)))
            self._began += time.perf_counter() - paused
            reached = reached_at([at for at, _, _ in self.points], [success for _, success, _ in self.points])
            return reached is None or self.num_timesteps < reached + self.steps_after
        return True


def reached_at(steps: Sequence[int], success: Sequence[float]) -> int | None:
    """Primitive steps at the first of two evaluations in a row with a success rate of `REACHED`; None if never."""
    at = learned_at([rate >= REACHED for rate in success])
    return None if at is None else steps[at]


def greedy(model: BaseAlgorithm, venv: VecEnv, seed: int) -> tuple[float, float]:
    """Success rate and mean primitive steps of one greedy episode in every environment."""
    venv.seed(seed)
    played = greedy_episodes(model, venv, venv.num_envs, masked=isinstance(model, OptionDQN | MaskablePPO))
    success, lengths = zip(*((info["is_success"], info["episode"]["l"]) for _, info in played), strict=True)
    return float(np.mean(success)), float(np.mean(lengths))
