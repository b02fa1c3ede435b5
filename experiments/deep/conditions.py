"""What is run for every seed: an arm in a task, with the options of the old task where there is one."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from experiments.common.gridworlds import world_of
from experiments.common.seeds import Result
from experiments.deep.agents import Evaluations, greedy, make_env, make_model
from experiments.deep.arms import BONUS, OPTIONS, Arm
from experiments.deep.settings import DeepSettings, family
from experiments.deep.tasks import SLACK, Task, optimal_steps
from sb3_options.callbacks import (
    IntrinsicRewardCallback,
    PrimitiveStepsCallback,
    SubgoalDiscoveryCallback,
)

SOURCE_SEED, EVAL_SEED, FINAL_SEED = 300_000, 500_000, 10_000_000
"""Added to a run's seed for the old task, for its evaluations, and for those at its end."""


class Served(MaskableEvalCallback):
    """Lets the discovery callback see an evaluation environment, and evaluates nothing itself."""

    def _on_step(self) -> bool:
        return True


class Trained(NamedTuple):
    """A run, the callback that discovered options in it, and the model."""

    result: Result
    discovery: SubgoalDiscoveryCallback | None
    model: BaseAlgorithm


def train(
    task: Task,
    algo: str,
    arm: Arm,
    settings: DeepSettings,
    seed: int,
    *,
    options: Path | None = None,
    carried: BaseAlgorithm | None = None,
    steps_after: int | None = None,
) -> Trained:
    """Train once in the target.

    Args:
        task: Which.
        algo: Of `ALGORITHMS`.
        arm: Of `ARMS`.
        settings: Of everything.
        seed: Of everything random.
        options: A file of options to begin with, in which case none are discovered.
        carried: Of the old task, whose parameters the model begins with.
        steps_after: In place of the settings'.

    Returns:
        ``steps``, ``success`` and ``length`` of each evaluation and the ``seconds`` of training before it,
        ``final_success`` and ``final_length``, and what was discovered; the callback that discovered it; the model.
    """
    limit = round(SLACK * optimal_steps(world_of(task.env, **task.target)))
    limit = min(limit, task.target.get("max_steps", limit))
    venv = make_env(task, algo, arm, settings, seed, settings.n_envs)
    eval_env = make_env(task, algo, arm, settings, EVAL_SEED + seed, settings.evaluation_episodes, max_steps=limit)
    if options is not None:
        for each in (venv, eval_env):
            for wrapper in each.envs:  # type: ignore[attr-defined]  # a DummyVecEnv
                wrapper.bank.load(options)
    if options is not None:
        settings = settings.for_brought_options()
    model = make_model(algo, venv, arm, settings, seed)
    if carried is not None:
        model.set_parameters(cast("Any", carried.get_parameters()))
    if steps_after is None:
        steps_after = settings.steps_after[family(algo)]
    evaluations = Evaluations(eval_env, settings.evaluate_every, steps_after, EVAL_SEED + seed)
    discovery = None
    callbacks: list[BaseCallback] = [evaluations]
    if arm in OPTIONS:
        discovery = SubgoalDiscoveryCallback(
            settings.discovery,
            settings.option,
            max_new_options=settings.max_new_options if options is None else 0,
            use={"max_option_exploration": settings.max_option_exploration[family(algo)]},
        )
        callbacks = [discovery, *callbacks, Served(eval_env)]
    elif arm == "repeats":
        callbacks = [PrimitiveStepsCallback(), *callbacks]
    if arm in BONUS:
        callbacks = [IntrinsicRewardCallback(BONUS[arm], weight=settings.bonus_weight, seed=seed), *callbacks]
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
        "seconds": evaluations.seconds,
        "final_success": float(np.mean([success for success, _ in last])),
        "final_length": float(np.mean([length for _, length in last])),
        "options": [
            {"episode": d.episode, "timestep": d.timestep, "subgoal": [float(x) for x in d.subgoal]}
            for d in (discovery.discoveries if discovery else [])
        ],
    }
    return Trained(result, discovery, model)


def train_source(task: Task, algo: str, arm: Arm, settings: DeepSettings, seed: int) -> Trained:
    """Train in the old task of a transfer, for its options or its network; bonus and n-step returns are the target's.

    Args:
        task: Which has a source.
        algo: As for `train`.
        arm: Likewise.
        settings: Of everything.
        seed: Of the run in the target; the source has one of its own.

    Returns:
        As of `train`.
    """
    source = Task(task.env, task.source or {}, n_timesteps=task.source_timesteps)
    plain: Arm = "options" if arm in OPTIONS else "stock"
    return train(source, algo, plain, settings, SOURCE_SEED + seed, steps_after=source.n_timesteps)


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
    if task.source is None or not (arm == "carried" or arm in OPTIONS):
        return train(task, algo, arm, settings, seed).result
    _, discovery, model = train_source(task, algo, arm, settings, seed)
    if discovery is None:
        return train(task, algo, arm, settings, seed, carried=model).result
    options = folder / "options" / f"{seed}.safetensors"
    options.parent.mkdir(parents=True, exist_ok=True)
    discovery.bank.save(options)
    subgoals = [[float(x) for x in d.subgoal] for d in discovery.discoveries]
    return {**train(task, algo, arm, settings, seed, options=options).result, "brought": subgoals}
