"""What is run for every seed: training with and without discovery, and what became of the options."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np
from sb3_contrib import MaskablePPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

import sb3_options.envs  # noqa: F401
from experiments.common.seeds import Result
from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.discovery.static_filter import near_start_and_goal
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.option_run import OptionRun
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.config import configure

ROOMS = "sb3_options/TwoRooms-v0"
COMPETENT_EPISODES = 20
COMPETENT_STEPS = 40
"""An agent is competent at the end of the first 20 episodes that reached the goal in 40 primitive steps on average.

The shortest way takes 18 to 26 of them, by where an episode starts.
"""

TASKS: dict[str, tuple[str, dict[str, object]]] = {
    "rooms": (ROOMS, {}),
    "lake": ("FrozenLake-v1", {"map_name": "8x8", "is_slippery": False}),
}
"""Environment and its arguments by the name of the task."""

CONDITIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "maskableppo": ("maskableppo", {}),
    "maskableppo, no discovery": ("maskableppo", {"max_new_options": 0}),
    "dqn": ("dqn", {}),
    "dqn, no discovery": ("dqn", {"max_new_options": 0}),
    "optiondqn": ("optiondqn", {}),
    "maskableppo, filter by distances": ("maskableppo", {"concepts": {"static_filter": near_start_and_goal()}}),
}
"""Algorithm, and what its callback is told, by the name of the condition."""

README: dict[str, dict[str, Any]] = {
    "as shown": {"ent_coef": 0.01, "normalize_advantage": False},
    "entropy alone": {"ent_coef": 0.01},
    "as Stable-Baselines3 has it": {},
}
"""Settings of MaskablePPO in the program of the README, by the name of the condition."""

README_STEPS = 50_000

BY_DEFAULT = {
    "rooms": tuple(CONDITIONS)[:5],
    "lake": ("maskableppo", "maskableppo, filter by distances"),
    "readme": tuple(README),
}
"""Conditions of each task."""


def competent_after(history: Sequence[EpisodeRecord]) -> int | None:
    """Primitive steps until an agent is competent; None if it never is."""
    for last in range(COMPETENT_EPISODES, len(history) + 1):
        window = history[last - COMPETENT_EPISODES : last]
        if all(e.success for e in window) and np.mean([e.steps for e in window]) <= COMPETENT_STEPS:
            return window[-1].timestep
    return None


def to_goal(env_id: str, subgoal: FloatArray) -> int | None:
    """Cells from a subgoal of the lake to its goal, in the last corner; None elsewhere."""
    if env_id == ROOMS:
        return None
    side = math.isqrt(len(subgoal))
    row, column = divmod(int(subgoal.argmax()), side)
    return 2 * (side - 1) - row - column


class Training(NamedTuple):
    """What learns, with which callback, for how many primitive steps."""

    model: BaseAlgorithm
    discovery: SubgoalDiscoveryCallback
    n_timesteps: int


class OptionUse(BaseCallback):
    """Counts what the slots ran."""

    def __init__(self) -> None:
        super().__init__()
        self.outside = 0
        self.endings: Counter[str] = Counter()
        self.steps = 0

    def _on_step(self) -> bool:
        for run in map(OptionRun.from_info, self.locals["infos"]):
            if run.index >= 0 and not run.inside:
                self.outside += 1
            elif run.index >= 0:
                self.endings[run.termination] += 1
                self.steps += run.duration
        return True


def made_as_train(task: str, condition: str, n_timesteps: int | None, seed: int) -> Training:
    """What ``train.py`` trains by default, in one of `TASKS`."""
    env_id, keywords = TASKS[task]
    algo, told = CONDITIONS[condition]
    config = configure(env=env_id, algo=algo, env_kwargs=keywords, seed=seed)
    model = make_model(config, runs.make_env(config, config.n_envs, seed))
    given = {"max_new_options": config.max_new_options, **told}
    discovery = SubgoalDiscoveryCallback(config.discovery, config.option, **given)
    return Training(model, discovery, n_timesteps or config.n_timesteps)


def made_as_in_readme(condition: str, n_timesteps: int | None, seed: int) -> Training:
    """What the program in the README trains, with a seed, which it has not."""
    env = OptionsWrapper(gym.make(ROOMS), max_options=4, gamma=0.99)
    model = MaskablePPO("MlpPolicy", env, n_steps=512, seed=seed, **README[condition])
    return Training(model, SubgoalDiscoveryCallback(), n_timesteps or README_STEPS)


def run(task: str, condition: str, n_timesteps: int | None, seed: int) -> Result:
    """Train once, with the defaults of ``train.py``, or as the README does.

    Args:
        task: Of `BY_DEFAULT`.
        condition: Of `CONDITIONS`, or of `README`.
        n_timesteps: Primitive steps; None for the default.
        seed: Of everything.

    Returns:
        What happened.
    """
    began = time.process_time()
    made = made_as_in_readme if task == "readme" else partial(made_as_train, task)
    model, discovery, length = made(condition, n_timesteps, seed)
    use, env_id = OptionUse(), ROOMS if task == "readme" else TASKS[task][0]
    with closing(cast(VecEnv, model.get_env())):
        model.learn(length, callback=[discovery, use])
    n_runs = sum(use.endings.values())
    return {
        "seed": seed,
        "processor_seconds": time.process_time() - began,
        "competent_after": competent_after(discovery.history),
        "episodes": len(discovery.history),
        "success_rate": float(np.mean([e.success for e in discovery.history[-100:]])) if discovery.history else None,
        "subgoals": [found.subgoal.tolist() for found in discovery.discoveries],
        "where": [found.where for found in discovery.discoveries],
        "steps_to_goal": [to_goal(env_id, found.subgoal) for found in discovery.discoveries],
        "found_after": [found.timestep for found in discovery.discoveries],
        "runs": n_runs,
        "steps_outside": use.outside,
        "mean_duration": use.steps / n_runs if n_runs else None,
        "reached_subgoal": use.endings["subgoal"] / n_runs if n_runs else None,
    }
