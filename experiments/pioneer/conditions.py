"""What is run for every seed: the main task with and without discovery, other tasks with its option, and DQN."""

from __future__ import annotations

from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from shutil import rmtree

import numpy as np

from experiments.common.agents import live, wrapper_of
from experiments.common.seeds import Result
from experiments.pioneer.agents import described, discoverer, evaluate, make_agent
from experiments.pioneer.settings import MAIN_TASK, TASKS, PioneerSettings
from sb3_options.atomic import atomic_write
from sb3_options.envs.pioneer.env import DEPOSIT_REWARD, STEP_REWARD, TOUCH_REWARD
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.evaluation import evaluate_run
from sb3_options.runs.folder import MONITOR
from sb3_options.runs.training import train

EVALUATION_SEED = 10_000
"""Added to a run's seed for the trials in which it is evaluated."""

DQN_EVALUATION_EPISODES = 100


def learning(settings: PioneerSettings, artifacts: Path, seed: int) -> Result:
    """The main task: primitives only, and with discovery.

    Up to the trial in which the option is made the two are the same agent, bit for bit.
    """
    result: Result = {}
    for name, max_new_options in (("primitive", 0), ("discovery", settings.options_per_run)):
        agent = make_agent(settings, MAIN_TASK, seed)
        callback = discoverer(settings, seed, max_new_options=max_new_options)
        result[name] = described(live(agent, settings.trials, callback).episodes)
        result[f"{name}_evaluation"] = evaluate(
            agent, settings.evaluation_trials, settings.evaluation_epsilon, EVALUATION_SEED + seed
        )
        if name == "discovery":
            found = callback.discoveries[0] if callback.discoveries else None
            result["option"] = {
                "trial": None if found is None else found.episode,
                "timestep": None if found is None else found.timestep,
                "displacement": None if found is None else float(found.subgoal[0]),
                "width": None if found is None else float(found.subgoal[1]),
            }
            file = _file(artifacts, seed)
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(file) as temporary:
                callback.bank.save(temporary)
        agent.env.close()  # type: ignore[union-attr]  # made with one
    return result


def transfer(settings: PioneerSettings, artifacts: Path, seed: int) -> Result:
    """The other tasks: primitives only, and with the option that the same seed found in the main task."""
    result: Result = {}
    for task, env_id in TASKS.items():
        result[task] = {}
        for name in ("primitive", "option"):
            agent = make_agent(settings, env_id, seed)
            if name == "option":
                wrapper_of(agent).bank.load(_file(artifacts, seed))
            callback = discoverer(settings, seed, max_new_options=0)
            result[task][name] = described(live(agent, settings.transfer_trials, callback).episodes)
            agent.env.close()  # type: ignore[union-attr]  # made with one
    return result


def dqn(config: TrainConfig, artifacts: Path, seed: int) -> Result:
    """DQN as `train.py` trains and evaluates it, with its defaults for the robot: with and without discovery."""
    result: Result = {}
    for name, most in (("primitive", 0), ("discovery", config.max_new_options)):
        folder = artifacts / str(seed) / name
        with redirect_stdout(StringIO()):
            of_seed = replace(config, seed=seed, max_new_options=most, progress=False, tensorboard_log=folder)
            run = train(of_seed).folder
            found = evaluate_run(run, episodes=DQN_EVALUATION_EPISODES, seed=EVALUATION_SEED + seed)
        returns, steps, _ = np.loadtxt(run / MONITOR / "0.monitor.csv", delimiter=",", skiprows=2, ndmin=2).T
        result[name] = {
            "steps": steps.tolist(),
            "returns": returns.tolist(),
            "success_rate": found.success_rate.mean,
            "evaluation_steps": found.steps.mean,
            "evaluation_touches": touches_of(found.success_rate.mean, found.steps.mean, found.mean_return.mean),
        }
        rmtree(folder)
    return result


def touches_of(successes: float, steps: float, total: float) -> float:
    """Wall touches of the task with one ball, from what is paid for them."""
    return (total - DEPOSIT_REWARD * successes - STEP_REWARD * steps) / TOUCH_REWARD


def _file(artifacts: Path, seed: int) -> Path:
    return artifacts / f"{seed}.safetensors"
