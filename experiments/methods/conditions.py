"""What is run for every seed: a task from nothing with discovery, and with its goal moved and the options of before."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar, cast

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from experiments.common.seeds import Result
from experiments.deep.agents import Evaluations, make_env, make_model, reached_at
from experiments.deep.conditions import EVAL_SEED, Served
from experiments.deep.settings import GAMMA, DeepSettings, family
from experiments.deep.tasks import Task
from experiments.first_hour.conditions import OptionUse
from experiments.methods.entrants import NONE, discovery_of
from experiments.methods.tasks import RaceTask, at_bottleneck, step_limit, task_for
from experiments.pioneer.agents import features
from experiments.pioneer.settings import PioneerSettings
from sb3_options import MacroQ
from sb3_options.callbacks import SubgoalDiscoveryCallback

MOVED_SEED = 300_000
"""Added to a run's seed where the goal has moved."""

LENGTHS = {"macroq": 120_000, "dqn": 30_000, "ppo": 40_000}
"""Primitive steps, at most, of each of the two trainings; also which learners there are."""

PIONEER_LENGTH = 10_000
"""Instead, for the robot, whose steps take longer."""

MACROQ: dict[str, Any] = {"learning_rate": 0.1, "epsilon": 0.1}

SETTINGS = DeepSettings(both_as="stock", max_new_options=4, max_option_exploration={"dqn": 0.5, "ppo": 0.5})
"""Those of `experiments.deep`, but for the library's own `OptionUse.max_option_exploration`. Of the algorithms it takes
those that were chosen without options: they favour none."""

EVALUATE_EVERY = {"dqn": 100, "ppo": 100}
"""Primitive steps between evaluations of deep learners: with options they learn some tasks in 500 steps."""

DECIDED = ("subgoal", "left_initiation", "max_duration")
"""How runs end that neither the episode nor a better choice cut off."""

P = ParamSpec("P")
R = TypeVar("R")


def length_of(task_name: str, learner: str) -> int:
    """Primitive steps of each of the two trainings, at most."""
    return PIONEER_LENGTH if task_name == "Pioneer" else LENGTHS[learner]


class Stopwatch:
    """Adds up processor time.

    Attributes:
        seconds: So far.
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def timed(self, function: Callable[P, R]) -> Callable[P, R]:
        """The same function, its time added."""

        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            began = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds += time.process_time() - began

        return run


class TimedDiscovery(SubgoalDiscoveryCallback):
    """Knows what processor time it took to find subgoals, without the learning of options."""

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.watch = Stopwatch()
        search = self._keeper.search
        search.add = self.watch.timed(search.add)  # type: ignore[method-assign]  # of this one
        search.search = self.watch.timed(search.search)  # type: ignore[method-assign]


class TimedEvaluations(Evaluations):
    """Knows what processor time it took."""

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.watch = Stopwatch()
        self._on_step = self.watch.timed(self._on_step)  # type: ignore[method-assign]  # of this one


@dataclass(frozen=True)
class Entry:
    """Who learns what, with whose options, for how long.

    Attributes:
        task: Of `TASKS`.
        learner: Of `LENGTHS`.
        entrant: Of `ENTRANTS`.
        changed: Settings of the entrant other than its defaults.
        n_timesteps: Primitive steps of each training, at most.
    """

    task: str
    learner: str
    entrant: str
    changed: Mapping[str, Any]
    n_timesteps: int


def run(entry: Entry, seed: int) -> Result:
    """One run.

    Args:
        entry: Of what.
        seed: Of everything random; where the goal has moved there is one of its own.

    Returns:
        ``same`` and ``moved``, as of `train`, and the subgoals that were ``found`` in the first.
    """
    task = task_for(entry.task, seed)
    callback, same = train(entry, task, task.same, seed)
    _, moved = train(entry, task, task.moved, MOVED_SEED + seed, callback.bank.content())
    found = [
        {
            "episode": each.episode,
            "timestep": each.timestep,
            "where": each.where,
            "near": at_bottleneck(task, each.subgoal.tolist()),
        }
        for each in callback.discoveries
    ]
    return {"seed": seed, "same": same, "moved": moved, "found": found}


def train(
    entry: Entry, task: RaceTask, kwargs: Mapping[str, Any], seed: int, options: bytes | None = None
) -> tuple[TimedDiscovery, Result]:
    """Train until 90 % of the episodes of two evaluations in a row are successes, or to the end.

    Args:
        entry: Of what.
        task: The task that it names.
        kwargs: Of the environment.
        seed: Of everything random.
        options: To begin with, in which case none are discovered.

    Returns:
        The callback, and ``steps`` of the first of these evaluations, None if there was none; those of the first two
        ``successes`` in training; how many runs of options
        were ``decided`` and ``reached`` their subgoal; ``seconds`` of training, without evaluations, and ``discovery``,
        what of them was discovery, in processor time.
    """
    n_envs = 1 if entry.learner == "macroq" else SETTINGS.n_envs
    venv = make_envs(entry, task, kwargs, seed, n_envs, options)
    limited = {**kwargs, "max_steps": step_limit(task, kwargs)}
    evaluated = make_envs(entry, task, limited, EVAL_SEED + seed, task.evaluation_episodes, options)
    discovery = make_discovery(entry, task, seed, discovers=options is None)
    every = EVALUATE_EVERY.get(entry.learner, task.evaluate_every)
    evaluations = TimedEvaluations(evaluated, every, 0, EVAL_SEED + seed)
    use = OptionUse()
    model = make_learner(entry, venv, seed)
    began = time.process_time()
    model.learn(entry.n_timesteps, callback=CallbackList([discovery, use, evaluations, Served(evaluated)]))
    seconds = time.process_time() - began - evaluations.watch.seconds
    venv.close()
    evaluated.close()
    ends = Counter({end: use.endings[end] for end in DECIDED})
    return discovery, {
        "steps": reached_at([at for at, _, _ in evaluations.points], [good for _, good, _ in evaluations.points]),
        "successes": [episode.timestep for episode in discovery.history if episode.success][:2],
        "trained": model.num_timesteps,
        "decided": ends.total(),
        "reached": ends["subgoal"],
        "seconds": round(seconds, 3),
        "discovery": round(discovery.watch.seconds, 4),
    }


def make_discovery(entry: Entry, task: RaceTask, seed: int, *, discovers: bool) -> TimedDiscovery:
    """The callback; the option learner is the same for all."""
    settings, method = discovery_of(entry.entrant, entry.changed, task, seed)
    return TimedDiscovery(
        settings,
        {**SETTINGS.option, **task.option},
        method=method,
        concepts={"static_filter": task.static_filter},
        max_new_options=SETTINGS.max_new_options if discovers and entry.entrant != NONE else 0,
        use={"max_option_exploration": SETTINGS.max_option_exploration[family(entry.learner)]},
    )


def make_envs(
    entry: Entry, task: RaceTask, kwargs: Mapping[str, Any], seed: int, n: int, options: bytes | None
) -> VecEnv:
    """Environments with slots, filled with the options that there are."""
    venv = make_env(Task(task.env, dict(kwargs)), entry.learner, "options", SETTINGS, seed, n)
    for wrapper in cast("DummyVecEnv", venv).envs:
        if options is not None:
            cast("Any", wrapper).bank.load(options)
    return venv


def make_learner(entry: Entry, venv: VecEnv, seed: int) -> BaseAlgorithm:
    """The untrained agent."""
    if entry.learner != "macroq":
        return make_model(entry.learner, venv, "options", SETTINGS, seed)
    tiles = features(PioneerSettings()) if entry.task == "Pioneer" else None
    return MacroQ(venv, features=tiles, gamma=GAMMA, seed=seed, **MACROQ)
