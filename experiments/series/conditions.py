"""What is run for every seed: a series of tasks, with options or the network carried on, or the last task alone."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Literal, TypeAlias, get_args

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from experiments.common.seeds import Result
from experiments.deep.agents import REACHED, Evaluations, make_model
from experiments.deep.conditions import EVAL_SEED, Served
from experiments.deep.settings import GAMMA, DeepSettings
from experiments.deep.tasks import SLACK, optimal_steps
from experiments.series.tasks import Chain
from sb3_options import OptionsWrapper
from sb3_options.callbacks import IntrinsicRewardCallback, SubgoalDiscoveryCallback
from sb3_options.runs.task_ends import free_slots

Arm: TypeAlias = Literal["options", "network", "options and network", "alone", "alone, count bonus"]
ARMS: tuple[Arm, ...] = get_args(Arm)
"""What a task takes over from the one before; ``alone`` is the last task from nothing."""

SETTINGS = DeepSettings(max_options=8)
"""Those of `experiments.deep`, with more slots; options may follow each other without a limit (`max_runs`)."""


def run(arm: Arm, chain: Chain, seed: int) -> Result:
    """Train once through the series, or in its last task.

    A task ends at the second of two evaluations in a row with a success rate of 90 %. An episode of an evaluation may
    take four times the steps of the best policy, or as many as one of training, if these are fewer.

    Args:
        arm: Of `ARMS`.
        chain: The tasks.
        seed: Of everything random.

    Returns:
        ``tasks``: of each that was begun ``rooms``, primitive ``steps``, ``success`` and ``length`` of the last
        evaluation, the ``best`` length there is, subgoals ``found``, and how many options were ``kept`` and ``freed``
        at its end; ``solved`` and ``steps`` of all; ``seconds``.
    """
    tasks: list[dict[str, Any]] = []
    carried: bytes | None = None
    parameters: Mapping[str, Any] | None = None
    left, began = chain.n_timesteps, time.perf_counter()
    for rooms in chain.series() if not arm.startswith("alone") else chain.series()[-1:]:
        best = optimal_steps(chain.task(rooms))  # type: ignore[arg-type]  # a gridworld
        venv, evaluated = _envs(arm, chain, rooms, seed, round(min(SLACK * best, chain.max_steps)), carried)
        model = make_model("ppo", venv, "options" if "options" in arm else "stock", SETTINGS, seed)
        if parameters is not None:
            model.set_parameters(dict(parameters))
        evaluations = Evaluations(evaluated, SETTINGS.evaluate_every, 0, EVAL_SEED + seed)
        callbacks: list[BaseCallback] = [evaluations]
        discovery = None
        if "options" in arm:
            discovery = _discovery(seed)
            callbacks = [discovery, evaluations, Served(evaluated)]
        elif arm == "alone, count bonus":
            callbacks = [IntrinsicRewardCallback("counts", weight=SETTINGS.bonus_weight, seed=seed), evaluations]
        model.learn(left, callback=CallbackList(callbacks))
        left -= model.num_timesteps
        _, success, length = evaluations.points[-1]
        solved = success >= REACHED and evaluations.points[-2][1] >= REACHED
        steps = model.num_timesteps
        tasks.append({"rooms": rooms, "steps": steps, "best": best, "success": success, "length": length})
        if discovery is not None:
            found = [each.subgoal.tolist() for each in discovery.discoveries]
            freed = len(free_slots(discovery.discovery, discovery.bank))
            tasks[-1] |= {"found": found, "freed": freed, "kept": len(discovery.bank)}
            carried = discovery.bank.content()
        if arm in ("network", "options and network"):
            parameters = model.get_parameters()
        if not solved or left <= 0:
            break
    return {
        "seed": seed,
        "solved": solved and tasks[-1]["rooms"] == chain.n_rooms,
        "steps": chain.n_timesteps - left,
        "tasks": tasks,
        "seconds": round(time.perf_counter() - began, 1),
    }


def _envs(arm: Arm, chain: Chain, rooms: int, seed: int, limit: int, carried: bytes | None) -> tuple[VecEnv, VecEnv]:
    """For training, and for evaluations of no more than ``limit`` steps; with the options that are carried on."""

    def make(max_steps: int) -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = Monitor(chain.task(rooms, max_steps))
        if "options" not in arm:
            return env
        optioned = OptionsWrapper(env, SETTINGS.max_options, gamma=GAMMA)
        if carried is not None:
            optioned.bank.load(carried)
        return optioned

    venv = DummyVecEnv([lambda: make(chain.max_steps)] * SETTINGS.n_envs)
    venv.seed(seed)
    return venv, DummyVecEnv([lambda: make(limit)] * SETTINGS.evaluation_episodes)


def _discovery(seed: int) -> SubgoalDiscoveryCallback:
    return SubgoalDiscoveryCallback(
        SETTINGS.discovery,
        SETTINGS.option,
        max_new_options=SETTINGS.max_new_options,
        max_option_exploration=SETTINGS.max_option_exploration["ppo"],
        seed=seed,
        **SETTINGS.callback,
    )
