"""Searching for settings with Optuna: the same seeds for every trial, each run in a process of its own.

Trials are in a journal file, which several commands may share; what ends early is tried again. What is proposed depends
on who is done first, so that with several at a time another search may choose otherwise.
"""

from __future__ import annotations

import json
import math
import os
import socket
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from optuna.visualization import matplotlib as optuna_plots
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.atomic import atomic_write
from sb3_options.runs import config as configs
from sb3_options.runs.compare import Goal
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.interrupts import raised
from sb3_options.runs.pictures import DPI
from sb3_options.runs.scored import ClusterProcesses, Processes, RunFailedError, score
from sb3_options.runs.search_space import Choices, Range, SearchSpace, Value, read_space
from sb3_options.runs.tune_config import TuneConfig
from sb3_options.runs.users_code import IMPORTING

JOURNAL, BEST, RUNS = "trials.log", "best.yml", "runs"
NAME = "settings"
"""Of the study in the journal."""

N_RANDOM = 8
"""Trials that are drawn at random before Optuna's TPE proposes."""

P_THRESHOLD = 0.1
"""A trial stops where its runs are worse than those of the best one with this p-value (Wilcoxon's test, paired)."""

N_BEFORE = 4
"""Runs of a trial before it may be stopped: with fewer the test says nothing."""

SEED_OF_WORKER = 10_000
"""More than a search has trials: commands that work together draw from generators of their own."""

N_SHOWN = 5
"""Trials in the table."""

IMPORTANCES = "importances.png"
PICTURES: dict[str, Callable[..., Any]] = {
    "history.png": optuna_plots.plot_optimization_history,
    "slice.png": optuna_plots.plot_slice,
    IMPORTANCES: partial(
        optuna_plots.plot_param_importances, evaluator=optuna.importance.PedAnovaImportanceEvaluator()
    ),
}
"""Optuna's own."""


def tune(config: TuneConfig, *, console: Console) -> TrainConfig:
    """Search, and leave ``best.yml`` and pictures.

    Args:
        config: What, and how.
        console: For what is said meanwhile, and the table.

    Returns:
        The best configuration.

    Raises:
        ValueError: The file describes no search, or another one than that in the folder, or every trial failed.
        OSError: A file cannot be read or written, or there is no ``--cluster``.
        ModuleNotFoundError: ``--cluster`` needs Ray, which is not installed.
        KeyboardInterrupt: The user ended it; the same command goes on.
    """
    goal = Goal.parsed(config.reach)
    space = read_space(config.space, {name: getattr(config, name) for name in IMPORTING})
    config.out.mkdir(parents=True, exist_ok=True)
    study = _study(config, space, goal)
    processes = Processes() if config.cluster is None else ClusterProcesses(config.cluster)
    _try_again(study)
    with raised(), ThreadPoolExecutor(config.jobs) as threads:
        jobs = [threads.submit(_work, study, config, space, goal, processes, console) for _ in range(config.jobs)]
        try:
            for job in jobs:
                job.result()
        except BaseException:
            processes.end()
            raise
    done = study.get_trials(states=(TrialState.COMPLETE,))
    if not done:
        failed = [trial.user_attrs["failed"] for trial in study.trials if "failed" in trial.user_attrs]
        raise ValueError(" ".join(["No trial was completed.", *failed[-1:]]))
    best = space.config(_values(space, study.best_params), config.first_seed, Path("runs"))
    configs.save(best, config.out / BEST)
    with pyplot.rc_context():  # Optuna changes the style of all later pictures
        _draw(study, config, goal)
    console.print(_table(study, config, goal))
    fresh = config.first_seed + config.seeds
    console.print(
        f"Judge it on another seed: sb3-options train --config {escape(str(config.out / BEST))} --seed {fresh}"
    )
    return best


def _study(config: TuneConfig, space: SearchSpace, goal: Goal) -> optuna.Study:
    """The search in the folder, or a new one.

    Raises:
        ValueError: There is another one.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    less = config.objective == "steps" or goal.measure == "length"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(config.out / JOURNAL))),
            study_name=NAME,
            pruner=optuna.pruners.WilcoxonPruner(p_threshold=P_THRESHOLD, n_startup_steps=N_BEFORE),
            direction="minimize" if less else "maximize",
            load_if_exists=True,
        )
        # A search that goes on draws other settings than it began with.
        seed = config.first_seed + len(study.trials) + SEED_OF_WORKER * config.worker
        study.sampler = optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=N_RANDOM, multivariate=True, constant_liar=True
        )
    asked = {
        "file": space.digest,
        "objective": config.objective,
        "reach": config.reach,
        "first-seed": config.first_seed,
        "seeds": config.seeds,
    }
    for name, value in study.user_attrs.get("asked", asked).items():
        if value != asked[name]:
            raise ValueError(
                f"{config.out} holds a search with {name} {value!r}, not {asked[name]!r}. Give another --out."
            )
    study.set_user_attr("asked", asked)
    return study


def _try_again(study: optuna.Study) -> None:
    """Give back what commands on this machine were at when they ended, with the runs that they had finished."""
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        host, pid = trial.user_attrs.get("by", (socket.gethostname(), 0))
        if host == socket.gethostname() and pid != os.getpid() and not _is_there(pid):
            study.enqueue_trial(trial.params, user_attrs={"place": _place(trial)})
            study.tell(trial.number, state=TrialState.FAIL)


def _is_there(pid: int) -> bool:
    if pid == 0:
        return False
    if os.name != "posix":
        return True  # there a signal of 0 would end it
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _place(trial: optuna.Trial | FrozenTrial) -> str:
    return str(trial.user_attrs.get("place", f"{trial.number:04}"))


def _work(
    study: optuna.Study, config: TuneConfig, space: SearchSpace, goal: Goal, processes: Processes, console: Console
) -> None:
    """Try one set of settings after another until there are enough."""
    counted = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
    while len(study.get_trials(deepcopy=False, states=counted)) < config.trials:
        trial = study.ask()
        trial.set_user_attr("by", [socket.gethostname(), os.getpid()])
        params = {name: _suggested(trial, name, of) for name, of in space.search.items()}
        state, value, said = TrialState.COMPLETE, None, ""
        try:
            value = _mean_score(trial, _values(space, params), config, space, goal, processes)
            said = f"{_shown(value, config)}{' primitive steps' if config.objective == 'steps' else ''}"
        except optuna.TrialPruned:
            state, said = TrialState.PRUNED, "stopped, for it is worse than the best"
        except (ValueError, RunFailedError) as error:
            state, said = TrialState.FAIL, f"failed: {error}"
            trial.set_user_attr("failed", str(error))
        study.tell(trial, value, state=state)
        number = f"Trial {trial.number + 1} of {config.trials}"
        console.print(escape(f"{number}: {said} ({', '.join(f'{name} {_short(of)}' for name, of in params.items())})"))
        failures = [t for t in study.get_trials(deepcopy=False) if "failed" in t.user_attrs]
        if len(failures) >= max(N_RANDOM, config.trials):
            raise ValueError(f"{len(failures)} trials failed. The last one: {failures[-1].user_attrs['failed']}")


def _mean_score(
    trial: optuna.Trial,
    proposed: dict[str, Value],
    config: TuneConfig,
    space: SearchSpace,
    goal: Goal,
    processes: Processes,
) -> float:
    scores: list[float] = []
    trusted = {name: getattr(config, name) for name in IMPORTING}
    for seed in range(config.first_seed, config.first_seed + config.seeds):
        run = space.config(proposed, seed, config.out / RUNS / _place(trial) / str(seed))
        scores.append(score(run, goal, config.objective, trusted, processes))
        trial.report(scores[-1], len(scores))
        if trial.should_prune():
            raise optuna.TrialPruned
    return sum(scores) / len(scores)


def _suggested(trial: optuna.Trial, name: str, of: Range | Choices) -> Any:
    if isinstance(of, Choices):
        return trial.suggest_categorical(name, of.names)
    if of.whole:
        return trial.suggest_int(name, int(of.low), int(of.high), step=int(of.step or 1), log=of.log)
    return trial.suggest_float(name, of.low, of.high, step=of.step, log=of.log)


def _values(space: SearchSpace, params: dict[str, Any]) -> dict[str, Value]:
    """What Optuna stored, as settings."""
    return {name: json.loads(v) if isinstance(space.search[name], Choices) else v for name, v in params.items()}


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _shown(value: float, config: TuneConfig) -> str:
    return f"{math.exp(value):,.0f}" if config.objective == "steps" else f"{value:.3g}"


def _table(study: optuna.Study, config: TuneConfig, goal: Goal) -> Table:
    done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    sign = 1.0 if study.direction == optuna.study.StudyDirection.MINIMIZE else -1.0
    names = list(done[0].params)
    states = [trial.state for trial in study.get_trials(deepcopy=False)]
    caption = (
        f"{len(done)} trials on {config.seeds} seeds, {states.count(TrialState.PRUNED)} stopped early, "
        f"{states.count(TrialState.FAIL)} failed. The best of many is better on these seeds than on others."
    )
    what = f"primitive steps to {goal}, geometric mean" if config.objective == "steps" else f"{goal.measure}, mean"
    table = Table("trial", what, *names, caption=caption)
    for trial in sorted(done, key=lambda trial: sign * (trial.value or 0.0))[:N_SHOWN]:
        assert trial.value is not None  # it is complete
        values = [_short(trial.params[name]) for name in names]
        table.add_row(str(trial.number + 1), _shown(trial.value, config), *values)
    return table


def _draw(study: optuna.Study, config: TuneConfig, goal: Goal) -> None:
    """Optuna's own pictures."""
    unit = f"ln(primitive steps to {goal})" if config.objective == "steps" else goal.measure
    values = {trial.value for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))}
    for name, plot in PICTURES.items():
        if name == IMPORTANCES and (len(values) < 2 or len(study.best_params) < 2):
            continue  # there is nothing to set side by side
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            warnings.simplefilter("ignore", UserWarning)  # of axes with a single value
            drawn = plot(study, target_name=unit)
        axes: list[Axes] = [drawn] if isinstance(drawn, Axes) else list(drawn.flat)
        for each in axes:
            each.xaxis.set_minor_formatter(NullFormatter())  # a narrow logarithmic axis writes its numbers over another
        figure = axes[0].get_figure(root=True)
        assert figure is not None  # these are drawn
        with atomic_write(config.out / name) as temporary:
            figure.savefig(temporary, dpi=DPI, format="png", bbox_inches="tight")
        pyplot.close(figure)  # Optuna's is pyplot's, which keeps all
