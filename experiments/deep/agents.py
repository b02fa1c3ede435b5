"""One run: a model with or without options, evaluated while it learns."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import gymnasium as gym
import numpy as np
from sb3_contrib import QRDQN, MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from experiments.common.seeds import Result
from experiments.deep.repeats import RandomRepeat
from experiments.deep.settings import GAMMA, DeepSettings, family
from experiments.deep.tasks import SLACK, Task, optimal_steps, world_of
from sb3_options import OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback, TrialSettings
from sb3_options.runs.evaluation import greedy_episodes

Arm: TypeAlias = Literal["stock", "options", "repeats"]
ARMS: tuple[Arm, ...] = get_args(Arm)
ALGORITHMS: dict[str, tuple[Any, Any]] = {
    "dqn": (DQN, OptionDQN),
    "ppo": (PPO, MaskablePPO),
    "dqn-unmasked": (DQN, DQN),
    "ppo-unmasked": (PPO, PPO),
    "qrdqn": (QRDQN, QRDQN),
}
"""Stock, and with options: where there is one, the variant that keeps to the options' initiation sets."""

SOURCE_SEED, EVAL_SEED, REPEAT_SEED, FINAL_SEED = 300_000, 500_000, 700_000, 10_000_000


REACHED = 0.9
"""The success rate that a run has to reach, in two evaluations in a row: one alone may be luck."""


def make_env(task: Task, algo: str, arm: Arm, settings: DeepSettings, seed: int, n_envs: int, **kwargs: Any) -> VecEnv:
    """The target's environments, with option slots unless it is the stock arm."""

    def make(i: int) -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = Monitor(gym.make(task.env, **{**task.target, **kwargs}))
        if arm == "stock":
            return env
        max_runs = settings.max_runs[family(algo)] if arm == "options" else 0
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
    if issubclass(stock, OffPolicyAlgorithm):
        buffer: dict[str, Any] = {}
        if arm != "stock":
            buffer = {"replay_buffer_class": OptionReplayBuffer, "replay_buffer_kwargs": settings.buffer}
        own = {**settings.arguments(algo, arm), **buffer}
    else:
        own = settings.arguments(algo, arm)
    made: BaseAlgorithm = (stock if arm == "stock" else with_options)("MlpPolicy", venv, **common, **own)
    return made


class Evaluations(BaseCallback):
    """Acts greedily in environments of its own, every so many primitive steps.

    Args:
        venv: One environment per episode, cut off where an episode counts as failed.
        every: Primitive steps.
        steps_after: Training ends this many primitive steps after `reached_at`.
        seed: Every evaluation sees the same episodes.
    """

    def __init__(self, venv: VecEnv, every: int, steps_after: int, seed: int) -> None:
        super().__init__()
        self.venv, self.every, self.steps_after, self.seed = venv, every, steps_after, seed
        self.points: list[tuple[int, float, float]] = []
        self._next = 0

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next = (self.num_timesteps // self.every + 1) * self.every
            self.points.append((self.num_timesteps, *greedy(self.model, self.venv, self.seed)))
            reached = reached_at([at for at, _, _ in self.points], [success for _, success, _ in self.points])
            return reached is None or self.num_timesteps < reached + self.steps_after
        return True


def reached_at(steps: Sequence[int], success: Sequence[float]) -> int | None:
    """Primitive steps at the first of two evaluations in a row with a success rate of `REACHED`; None if never."""
    for at, first, second in zip(steps, success, success[1:], strict=False):
        if min(first, second) >= REACHED:
            return at
    return None


def greedy(model: BaseAlgorithm, venv: VecEnv, seed: int) -> tuple[float, float]:
    """Success rate and mean primitive steps of one greedy episode in every environment."""
    venv.seed(seed)
    played = greedy_episodes(model, venv, venv.num_envs, masked=isinstance(model, OptionDQN | MaskablePPO))
    success, lengths = zip(*((info["is_success"], info["episode"]["l"]) for _, info in played), strict=True)
    return float(np.mean(success)), float(np.mean(lengths))


class Served(EvalCallback):
    """Lets the discovery callback see an evaluation environment, and evaluates nothing itself."""

    def _on_step(self) -> bool:
        return True


def train(
    task: Task,
    algo: str,
    arm: Arm,
    settings: DeepSettings,
    seed: int,
    *,
    options: Path | None = None,
    steps_after: int | None = None,
) -> tuple[Result, SubgoalDiscoveryCallback | None]:
    """Train once in the target.

    Args:
        task: Which.
        algo: Of `ALGORITHMS`.
        arm: Stock, discovered options, or random repeats in their place.
        settings: Of everything.
        seed: Of everything random.
        options: A file of options to begin with, in which case none are discovered.
        steps_after: In place of the settings'.

    Returns:
        ``steps``, ``success`` and ``length`` of each evaluation, ``final_success`` and ``final_length``, and what was
        discovered; the callback that discovered it.
    """
    limit = round(SLACK * optimal_steps(world_of(task.env, **task.target)))
    venv = make_env(task, algo, arm, settings, seed, settings.n_envs)
    eval_env = make_env(task, algo, arm, settings, EVAL_SEED + seed, settings.evaluation_episodes, max_steps=limit)
    if options is not None:
        for each in (venv, eval_env):
            for wrapper in each.envs:  # type: ignore[attr-defined]  # a DummyVecEnv
                wrapper.bank.load(options)
    model = make_model(algo, venv, arm, settings, seed)
    if steps_after is None:
        steps_after = settings.steps_after[family(algo)]
    evaluations = Evaluations(eval_env, settings.evaluate_every, steps_after, EVAL_SEED + seed)
    discovery = None
    callbacks: list[BaseCallback] = [evaluations]
    if arm == "options":
        withhold = settings.withhold[family(algo)]
        discovery = SubgoalDiscoveryCallback(
            settings.discovery,
            settings.option,
            max_new_options=settings.max_new_options if options is None else 0,
            max_option_exploration=settings.max_option_exploration[family(algo)],
            trial=TrialSettings(withhold=withhold) if withhold else None,
            seed=seed,
            **settings.callback,
        )
        callbacks = [discovery, *callbacks, Served(eval_env)]
    elif arm == "repeats":
        callbacks = [PrimitiveStepsCallback(), *callbacks]
    model.learn(task.n_timesteps, callback=CallbackList(callbacks))
    steps, success, lengths = zip(*evaluations.points, strict=True)
    last = [
        greedy(model, eval_env, FINAL_SEED + seed * settings.final_evaluations + i)
        for i in range(settings.final_evaluations)
    ]
    result: Result = {
        "seed": seed,
        "steps": list(steps),
        "success": list(success),
        "length": list(lengths),
        "final_success": float(np.mean([success for success, _ in last])),
        "final_length": float(np.mean([length for _, length in last])),
        "options": [
            {"episode": d.episode, "timestep": d.timestep, "subgoal": [float(x) for x in d.subgoal]}
            for d in (discovery.discoveries if discovery else [])
        ],
    }
    return result, discovery


def discover(task: Task, algo: str, settings: DeepSettings, seed: int) -> SubgoalDiscoveryCallback:
    """Train in the old task of a transfer, for its options.

    Args:
        task: Which has a source.
        algo: As for `train`.
        settings: Of everything; but options are not tried there, as what does harm may help where the goal has moved.
        seed: Of the run in the target; the source has one of its own.

    Returns:
        The callback that holds the options.
    """
    source = Task(task.env, task.source or {}, n_timesteps=task.source_timesteps)
    untried = dataclasses.replace(settings, withhold=dict.fromkeys(settings.withhold, 0.0))
    discovery = train(source, algo, "options", untried, SOURCE_SEED + seed, steps_after=source.n_timesteps)[1]
    assert discovery is not None  # of this arm
    return discovery


def run(task: Task, algo: str, arm: Arm, settings: DeepSettings, folder: Path, seed: int) -> Result:
    """One run of one arm.

    Args:
        task: Which; with a source, options are discovered there by the same algorithm and brought along.
        algo: As for `train`.
        arm: As for `train`.
        settings: Of everything.
        folder: For the options of the source.
        seed: Of everything random; the source has one of its own.

    Returns:
        As of `train`; with ``brought``, the subgoals of the options brought along.
    """
    if task.source is None or arm != "options":
        return train(task, algo, arm, settings, seed)[0]
    discovery = discover(task, algo, settings, seed)
    options = folder / "options" / f"{seed}.safetensors"
    options.parent.mkdir(parents=True, exist_ok=True)
    discovery.bank.save(options)
    subgoals = [[float(x) for x in d.subgoal] for d in discovery.discoveries]
    return {**train(task, algo, arm, settings, seed, options=options)[0], "brought": subgoals}
