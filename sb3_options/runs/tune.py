"""Searching for settings with Optuna: the same seeds for every trial.

With several jobs, what is proposed depends on which of them ends first, so another search may choose otherwise.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import shlex
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from joblib import Parallel, delayed, parallel_config
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
from optuna.trial import TrialState
from optuna.visualization import matplotlib as optuna_plots
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.atomic import atomic_write
from sb3_options.execution.ray_cluster import connect
from sb3_options.runs import config as configs
from sb3_options.runs import yaml_file
from sb3_options.runs.algorithms import class_of
from sb3_options.runs.commands import TuneConfig
from sb3_options.runs.compare import Goal, at_once, at_the_end, learned_after
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.interrupts import raised
from sb3_options.runs.logged import NothingLoggedError, Run, read_run
from sb3_options.runs.pictures import DPI
from sb3_options.runs.search import Search, best_of, choices, opened, short, values_of, work
from sb3_options.runs.training import train
from sb3_options.runs.under_way import held
from sb3_options.runs.users_code import IMPORTING, flag, named_in_errors, with_trusted

BEST = "best.yml"
RUNS = "runs"
LOG = "output.txt"

N_SHOWN = 5
"""Trials in the table."""

PARTS = ("base", "search")
FIXED = ("algo", "seed", "tensorboard_log", "compare", "progress", *IMPORTING, *configs.GROUPS, "algo_kwargs", "method")
"""What cannot be varied: a search has one algorithm, and seeds and folders of its own."""

IMPORTANCES = "importances.png"
PICTURES: dict[str, Callable[..., Any]] = {
    "history.png": optuna_plots.plot_optimization_history,
    "slice.png": optuna_plots.plot_slice,
    IMPORTANCES: partial(
        optuna_plots.plot_param_importances, evaluator=optuna.importance.PedAnovaImportanceEvaluator()
    ),
}
"""Optuna's own."""


class SearchSpace(NamedTuple):
    """Settings that stay, and distributions of those that vary, by name; ``discovery.decay`` is one of a group."""

    where: Path
    base: dict[str, Any]
    search: dict[str, BaseDistribution]

    def config(self, proposed: Mapping[str, Any], seed: int, folder: Path) -> TrainConfig:
        """The configuration of a run, whose run folder will be in ``folder``."""
        own = {"seed": seed, "tensorboard_log": str(folder), "progress": False, "compare": False}
        return configs.build({**self.base, **proposed, **own}, self.where)

    @property
    def digest(self) -> str:
        """Tells two searches apart."""
        content = {"base": self.base, "search": {name: repr(of) for name, of in self.search.items()}}
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


def read_space(path: Path, trusted: Mapping[str, str | None]) -> SearchSpace:
    """A file with ``base`` and ``search``.

    Args:
        path: Of the file.
        trusted: What the user has named on the command line and may import modules.

    Raises:
        OSError: The file cannot be read.
        ModuleNotFoundError: The algorithm is one of sb3-contrib's, which is not installed.
        ValueError: It describes no search, or names what would import a module.
    """
    with named_in_errors("tune", path):
        content = yaml_file.read_mapping(path)
    for name, part in content.items():
        if name not in PARTS or not isinstance(part, dict):
            raise ValueError(f"{path}: write `base:` and `search:`, each with `name: value` lines, not {name!r}.")
    base = {str(name).replace("-", "_"): value for name, value in content.get("base", {}).items()}
    search = {str(name).replace("-", "_"): value for name, value in content.get("search", {}).items()}
    if not search:
        raise ValueError(f"{path}: `search:` names nothing. Say what varies: `learning_rate: [0.001, 0.01]`.")
    base = with_trusted(base, trusted, path)
    for name in search:
        if name in FIXED:
            raise ValueError(f"{path}: {name} cannot be varied. Search apart, or name a setting within it.")
    space = SearchSpace(path, base, {name: _distribution(path, name, of) for name, of in search.items()})
    for end in (0, -1):  # names and both ends are right
        config = space.config({name: of[end] for name, of in map(_ends, search.items())}, 0, Path("runs"))
    class_of(config.algo)
    return space


def _ends(setting: tuple[str, Any]) -> tuple[str, list[Any]]:
    name, of = setting
    return name, of if isinstance(of, list) else [of["low"], of["high"]]


def _distribution(path: Path, name: str, of: Any) -> BaseDistribution:
    if isinstance(of, list) and len(of) >= 2:
        return choices(of)
    try:
        whole = isinstance(of["low"], int) and isinstance(of["high"], int)
        return IntDistribution(**of) if whole else FloatDistribution(**of)
    except (TypeError, ValueError, KeyError) as error:
        example = "{low: 0.0001, high: 0.01, log: true} or a list of two values or more"
        raise ValueError(f"{path}: {name} takes {example}, got {of!r}: {error}") from error


def tune(config: TuneConfig, console: Console) -> TrainConfig:
    """Search, and leave ``best.yml`` and pictures.

    Args:
        config: What, and how.
        console: For messages and the table.

    Returns:
        The best configuration.

    Raises:
        ValueError: The file describes no search, or another one than that in the folder, or trials failed.
        OSError: A file cannot be read or written, or there is no ``--cluster``.
        ModuleNotFoundError: The algorithm needs sb3-contrib, or ``--cluster`` Ray, which is not installed.
        KeyboardInterrupt: The user ended it; the same command goes on.
    """
    goal = Goal.parsed(config.reach)
    space = read_space(config.space, _trusted(config))
    search = _search(config, space, goal)
    config.out.mkdir(parents=True, exist_ok=True)
    with held(config.out):
        study = opened(search)
        with raised():
            if config.jobs == 1 and config.cluster is None:
                work(study, search, console)
            else:
                with _backend(config):
                    Parallel(n_jobs=config.jobs)(delayed(_job)(config, job) for job in range(1, config.jobs + 1))
    _, chosen = best_of(study, search)
    best = dataclasses.replace(space.config(chosen, config.first_seed, Path("runs")), progress=True)
    configs.save(best, config.out / BEST)
    with pyplot.rc_context():  # Optuna changes the style of all later pictures
        _draw(study, config, goal)
    console.print(_table(study, search, config, goal, best.n_timesteps))
    runs = [read_run(path.parent) for path in config.out.glob(f"{RUNS}/*/*/*/*/{configs.CONFIG}")]
    if config.objective == "steps" and at_once(
        goal, runs, "eval" if all(r.curves["eval"] for r in runs) else "rollout"
    ):
        console.print(f"[yellow]Warning:[/] most runs had {goal} at their first log entry, so chance chose. Search for")
        console.print("another --reach, such as length=40, in another --out.")
    trusted = [word for name, text in _trusted(config).items() if text is not None for word in (flag(name), text)]
    words = ["--config", str(config.out / BEST), "--seed", str(config.first_seed + config.seeds), *trusted]
    console.print(escape(f"Judge it on another seed: sb3-options train {shlex.join(words)}"), soft_wrap=True)
    return best


def _trusted(config: TuneConfig) -> dict[str, str | None]:
    return {name: getattr(config, name) for name in IMPORTING}


def _backend(config: TuneConfig) -> contextlib.AbstractContextManager[Any]:
    """Where the jobs run: processes of this machine, or Ray's."""
    if config.cluster is None:
        return contextlib.nullcontext()
    connect(config.cluster)
    from ray.util.joblib import register_ray

    register_ray()  # type: ignore[no-untyped-call]  # Ray's
    backend: contextlib.AbstractContextManager[Any] = parallel_config("ray")
    return backend


def _job(config: TuneConfig, job: int) -> None:
    """One of several processes that work on a search."""
    space = read_space(config.space, _trusted(config))
    search = _search(config, space, Goal.parsed(config.reach))
    work(opened(search, job), search, Console(highlight=False, soft_wrap=True))


def _search(config: TuneConfig, space: SearchSpace, goal: Goal) -> Search:
    def scores(place: str, proposed: dict[str, Any]) -> Iterator[float]:
        for seed in range(config.first_seed, config.first_seed + config.seeds):
            yield score(space.config(proposed, seed, config.out / RUNS / place / str(seed)), goal, config.objective)

    return Search(
        config.out,
        space.search,
        scores,
        config.trials,
        minimise=config.objective == "steps" or goal.measure == "length",
        seed=config.first_seed,
        asked={
            "file": space.digest,
            "objective": config.objective,
            "reach": config.reach,
            "first-seed": config.first_seed,
            "seeds": config.seeds,
        },
        shown=lambda value: f"{_shown(value, config)}{' primitive steps' if config.objective == 'steps' else ''}",
    )


def score(run: TrainConfig, goal: Goal, objective: str) -> float:
    """Train once, and say how good the run was.

    Args:
        run: Its ``tensorboard_log`` is a folder for this run alone.
        goal: As for `score_of`.
        objective: As for `score_of`.

    Raises:
        ValueError: Training logged nothing that can be scored.
        KeyboardInterrupt: It was interrupted.
    """
    run.tensorboard_log.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        log = stack.enter_context((run.tensorboard_log / LOG).open("w", encoding="utf-8"))
        stack.enter_context(contextlib.redirect_stdout(log))
        stack.enter_context(contextlib.redirect_stderr(log))
        trained = train(dataclasses.replace(run, checkpoint_freq=0))
    if not trained.finished:
        raise KeyboardInterrupt
    try:
        return score_of(read_run(trained.folder), goal, objective, run.n_timesteps)
    except NothingLoggedError as error:
        raise ValueError(
            f"No training episode ended within the budget of {run.n_timesteps:,} primitive steps. Give a larger "
            "n_timesteps, or the environment a shorter time limit."
        ) from error


def score_of(run: Run, goal: Goal, objective: str, n_timesteps: int) -> float:
    """How good a run was.

    Args:
        run: What it logged; evaluations count, if it made any.
        goal: What is waited for, or whose end counts.
        objective: ``steps`` or ``end``.
        n_timesteps: Of the whole run, which one that never reaches the goal counts with.

    Returns:
        The logarithm of the primitive steps to the goal; or the measure's mean over the last tenth of training.

    Raises:
        ValueError: The run did not log it.
    """
    curves = run.curves["eval"] or run.curves["rollout"]
    if goal.measure not in curves:
        raise ValueError(f"{run.folder} did not log {goal.measure}: choose --reach {', '.join(curves)}.")
    curve = curves[goal.measure]
    if objective == "end":
        return at_the_end(curve, n_timesteps)
    return math.log(max(1.0, learned_after(curve, goal) or n_timesteps))


def _shown(value: float, config: TuneConfig) -> str:
    return f"{math.exp(value):,.0f}" if config.objective == "steps" else f"{value:.3g}"


def _table(study: optuna.Study, search: Search, config: TuneConfig, goal: Goal, n_timesteps: int) -> Table:
    done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    states = [trial.state for trial in study.get_trials(deepcopy=False)]
    caption = (
        f"{len(done)} trials on {config.seeds} seeds, {states.count(TrialState.PRUNED)} stopped early, "
        f"{states.count(TrialState.FAIL)} failed. The best of many is better on these seeds than on others."
    )
    budgets = [math.log(float(trial.params.get("n_timesteps", n_timesteps))) for trial in done]
    never = sum(math.isclose(trial.value or 0.0, most) for trial, most in zip(done, budgets, strict=True))
    if config.objective == "steps" and never:
        caption += f" In {never} of these trials no run reached {goal}: they count with all their steps."
    measure = f"primitive steps to {goal}, geometric mean" if config.objective == "steps" else f"{goal.measure}, mean"
    table = Table("trial", measure, *done[0].params, caption=caption)
    for trial in sorted(done, key=lambda trial: (trial.value or 0.0) * (1 if search.minimise else -1))[:N_SHOWN]:
        values = [short(value) for value in values_of(trial, search).values()]
        table.add_row(str(trial.number + 1), _shown(trial.value or 0.0, config), *values)
    return table


def _draw(study: optuna.Study, config: TuneConfig, goal: Goal) -> None:
    """Optuna's own pictures."""
    unit = f"ln(primitive steps to {goal})" if config.objective == "steps" else goal.measure
    values = {trial.value for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))}
    for name, plot in PICTURES.items():
        if name == IMPORTANCES and (len(values) < 2 or len(study.best_params) < 2):
            continue  # there is nothing to compare
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
