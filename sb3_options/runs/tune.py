"""Searching for settings with Optuna: the same seeds for every trial, each run in a process of its own.

What is proposed depends on who is done first, so that with several at a time another search may choose otherwise.
"""

from __future__ import annotations

import math
import shlex
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter
from optuna.trial import TrialState
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
from sb3_options.runs.scored import ClusterProcesses, Processes, score, was_there_at_once
from sb3_options.runs.search import FirstTrialsFailedError, Search, best_of, opened, short, work
from sb3_options.runs.search_space import SearchSpace, Value, read_space
from sb3_options.runs.tune_config import TuneConfig
from sb3_options.runs.users_code import IMPORTING, flag

BEST, RUNS = "best.yml", "runs"

SEED_OF_WORKER = 10_000
"""More than a search has trials: commands that work together draw from generators of their own."""

N_SHOWN = 5
"""Trials in the table."""

AT_ONCE = (
    "{goal} was there at the first log entry of {folder}. Where it is in most runs, the search chooses by chance: "
    "interrupt it and choose another --reach, length=40 say, and another --out."
)

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
        ModuleNotFoundError: The algorithm needs sb3-contrib, or ``--cluster`` Ray, which is not installed.
        KeyboardInterrupt: The user ended it; the same command goes on.
    """
    goal = Goal.parsed(config.reach)
    space = read_space(config.space, {name: getattr(config, name) for name in IMPORTING})
    processes = Processes() if config.cluster is None else ClusterProcesses(config.cluster)
    search = _search(config, space, goal, processes, console)
    study = opened(search)
    with raised(), ThreadPoolExecutor(config.jobs) as threads:
        jobs = [threads.submit(work, study, search, console) for _ in range(config.jobs)]
        try:
            for job in jobs:
                with suppress(FirstTrialsFailedError):
                    job.result()
            if not study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED)):
                for job in jobs:
                    job.result()
            work(study, search, console)  # what is left where a job gave up before another came to an end
        except BaseException:
            processes.end()
            raise
    _, chosen = best_of(study, search)
    best = space.config(chosen, config.first_seed, Path("runs"))
    configs.save(best, config.out / BEST)
    with pyplot.rc_context():  # Optuna changes the style of all later pictures
        _draw(study, config, goal)
    console.print(_table(study, config, goal, best.n_timesteps))
    trusted = [word for name in IMPORTING if (text := getattr(config, name)) is not None for word in (flag(name), text)]
    words = ["--config", str(config.out / BEST), "--seed", str(config.first_seed + config.seeds), *trusted]
    console.print(escape(f"Judge it on another seed: sb3-options train {shlex.join(words)}"), soft_wrap=True)
    return best


def _search(config: TuneConfig, space: SearchSpace, goal: Goal, processes: Processes, console: Console) -> Search:
    trusted = {name: getattr(config, name) for name in IMPORTING}
    warned: list[Path] = []

    def scores(place: str, proposed: dict[str, Value]) -> Iterator[float]:
        for seed in range(config.first_seed, config.first_seed + config.seeds):
            run = space.config(proposed, seed, config.out / RUNS / place / str(seed))
            found = score(run, goal, config.objective, trusted, processes)
            if config.objective == "steps" and not warned and was_there_at_once(run):
                warned.append(run.tensorboard_log)
                text = AT_ONCE.format(goal=goal, folder=run.tensorboard_log)
                console.print(f"[yellow]Warning:[/] {escape(text)}", soft_wrap=True)
            yield found

    return Search(
        config.out,
        space.search,
        scores,
        config.trials,
        minimise=config.objective == "steps" or goal.measure == "length",
        seed=config.first_seed + SEED_OF_WORKER * config.worker,
        asked={
            "file": space.digest,
            "objective": config.objective,
            "reach": config.reach,
            "first-seed": config.first_seed,
            "seeds": config.seeds,
        },
        shown=lambda value: f"{_shown(value, config)}{' primitive steps' if config.objective == 'steps' else ''}",
    )


def _shown(value: float, config: TuneConfig) -> str:
    return f"{math.exp(value):,.0f}" if config.objective == "steps" else f"{value:.3g}"


def _table(study: optuna.Study, config: TuneConfig, goal: Goal, n_timesteps: int) -> Table:
    done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    sign = 1.0 if study.direction == optuna.study.StudyDirection.MINIMIZE else -1.0
    names = list(done[0].params)
    states = [trial.state for trial in study.get_trials(deepcopy=False)]
    caption = (
        f"{len(done)} trials on {config.seeds} seeds, {states.count(TrialState.PRUNED)} stopped early, "
        f"{states.count(TrialState.FAIL)} failed. The best of many is better on these seeds than on others."
    )
    budgets = [math.log(float(trial.params.get("n_timesteps", n_timesteps))) for trial in done]
    never = sum(math.isclose(trial.value or 0.0, most) for trial, most in zip(done, budgets, strict=True))
    if config.objective == "steps" and never:
        caption += f" In {never} of these trials no run reached {goal}: they count with all their steps."
    what = f"primitive steps to {goal}, geometric mean" if config.objective == "steps" else f"{goal.measure}, mean"
    table = Table("trial", what, *names, caption=caption)
    for trial in sorted(done, key=lambda trial: sign * (trial.value or 0.0))[:N_SHOWN]:
        assert trial.value is not None  # it is complete
        values = [short(trial.params[name]) for name in names]
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
