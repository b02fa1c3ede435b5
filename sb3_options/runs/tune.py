"""Searching for settings with Optuna: TPE proposes, and every trial is trained on the same seeds.

Wilcoxon's test stops a trial whose runs so far are worse, seed by seed, than those of the best one. With several jobs,
what is proposed depends on which of them ends first, so another search may choose otherwise.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import shlex
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from joblib import Parallel, delayed, parallel_config
from matplotlib import pyplot
from matplotlib.ticker import NullFormatter
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from optuna.visualization import matplotlib as optuna_plots
from rich.console import Console
from rich.markup import escape

from sb3_options.atomic import atomic_write
from sb3_options.execution.ray_cluster import connect
from sb3_options.runs import config as configs
from sb3_options.runs import yaml_file
from sb3_options.runs.algorithms import class_of
from sb3_options.runs.commands import TuneConfig
from sb3_options.runs.compare import Goal, at_once, at_the_end, learned_after
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.logged import NothingLoggedError, Run, read_run
from sb3_options.runs.pictures import DPI
from sb3_options.runs.training import train
from sb3_options.runs.under_way import held
from sb3_options.runs.users_code import IMPORTING, flag, named_in_errors, with_trusted

BEST = "best.yml"
JOURNAL = "trials.log"
RUNS = "runs"
LOG = "output.txt"
NAME = "settings"
"""Of the study in the journal."""

N_RANDOM = 8
"""Trials that are drawn at random before TPE proposes."""

P_THRESHOLD = 0.1
N_BEFORE = 4
"""Runs of a trial before it may be stopped: with fewer, Wilcoxon's test says nothing."""

N_FAILED = 3
"""Failures that end a search in which no trial was completed."""

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


class SearchSpace(NamedTuple):
    """Settings that stay, and distributions of those that vary, by name; ``discovery.decay`` is one of a group."""

    where: Path
    base: dict[str, Any]
    search: dict[str, BaseDistribution]

    def config(self, proposed: Mapping[str, Any], seed: int, folder: Path) -> TrainConfig:
        """The configuration of a run, whose run folder will be in ``folder``."""
        own = {"seed": seed, "tensorboard_log": str(folder), "progress": False, "compare": False}
        return configs.build({**self.base, **proposed, **own}, self.where)

    def values(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Settings of a trial's parameters."""
        categorical = {name for name, of in self.search.items() if isinstance(of, CategoricalDistribution)}
        return {name: json.loads(value) if name in categorical else value for name, value in params.items()}


def read_space(path: Path, trusted: Mapping[str, str | None]) -> SearchSpace:
    """A file with ``base`` and ``search``; ``trusted`` are settings of the command line that may import modules."""
    with named_in_errors("tune", path):
        content = yaml_file.read_mapping(path)
    if not content.keys() <= {"base", "search"} or not all(isinstance(part, dict) for part in content.values()):
        raise ValueError(f"{path}: write `base:` and `search:`, each with `name: value` lines, and nothing else.")
    base = {str(name).replace("-", "_"): value for name, value in content.get("base", {}).items()}
    search = {str(name).replace("-", "_"): value for name, value in content.get("search", {}).items()}
    if not search:
        raise ValueError(f"{path}: `search:` names nothing. Say what varies: `learning_rate: [0.001, 0.01]`.")
    for name in search:
        if name in FIXED:
            raise ValueError(f"{path}: {name} cannot be varied. Search apart, or name a setting within it.")
    distributions = {name: _distribution(path, name, of) for name, of in search.items()}
    space = SearchSpace(path, with_trusted(base, trusted, path), distributions)
    ends = {name: of if isinstance(of, list) else [of["low"], of["high"]] for name, of in search.items()}
    for end in (0, -1):  # names and both ends are right
        class_of(space.config({name: of[end] for name, of in ends.items()}, 0, Path("runs")).algo)
    return space


def _distribution(path: Path, name: str, of: Any) -> BaseDistribution:
    try:
        if isinstance(of, list) and len(of) >= 2:
            return CategoricalDistribution([json.dumps(value) for value in of])  # Optuna hashes values
        whole = isinstance(of["low"], int) and isinstance(of["high"], int)
        return IntDistribution(**of) if whole else FloatDistribution(**of)
    except (TypeError, ValueError, KeyError) as error:
        example = "{low: 0.0001, high: 0.01, log: true} or a list of two values or more"
        raise ValueError(f"{path}: {name} takes {example}, got {of!r}: {error}") from error


def tune(config: TuneConfig, console: Console) -> TrainConfig:
    """Search, and leave ``best.yml`` and pictures; the best configuration is returned."""
    goal = Goal.parsed(config.reach)
    trusted = {name: getattr(config, name) for name in IMPORTING}
    space = read_space(config.space, trusted)
    config.out.mkdir(parents=True, exist_ok=True)
    with held(config.out):
        study = _opened(config, goal, 0)
        _check_same(study, config, space)
        for cut_off in study.get_trials(states=(TrialState.RUNNING,)):
            study.enqueue_trial(cut_off.params)
            study.tell(cut_off.number, state=TrialState.FAIL)
        with _backend(config):
            Parallel(n_jobs=config.jobs)(delayed(_work)(config, space, job) for job in range(config.jobs))
    best = dataclasses.replace(space.config(space.values(study.best_params), 0, Path("runs")), progress=True)
    configs.save(best, config.out / BEST)
    _draw(study, config, goal)
    states = [trial.state for trial in study.trials]
    console.print(
        f"Best of {states.count(TrialState.COMPLETE)} trials on {config.seeds} seeds "
        f"({states.count(TrialState.PRUNED)} stopped early, {states.count(TrialState.FAIL)} failed): trial "
        f"{study.best_trial.number + 1}, {_shown(study.best_value, config)}. The best of many is better on these "
        "seeds than on others."
    )
    runs = [read_run(path.parent) for path in config.out.glob(f"{RUNS}/*/*/*/*/{configs.CONFIG}")]
    source = "eval" if all(run.curves["eval"] for run in runs) else "rollout"
    if config.objective == "steps" and at_once(goal, runs, source):
        console.print(f"[yellow]Warning:[/] most runs had {goal} at their first log entry, so chance chose. Search for")
        console.print("another --reach, such as length=40, in another --out.")
    words = ["--config", str(config.out / BEST), "--seed", str(config.seeds)]
    words += [word for name, text in trusted.items() if text is not None for word in (flag(name), text)]
    console.print(escape(f"Judge it on another seed: sb3-options train {shlex.join(words)}"), soft_wrap=True)
    return best


def _opened(config: TuneConfig, goal: Goal, job: int) -> optuna.Study:
    """The search in the folder, or a new one; each job draws other settings, and so does a search that goes on."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(config.out / JOURNAL))),
            study_name=NAME,
            pruner=optuna.pruners.WilcoxonPruner(p_threshold=P_THRESHOLD, n_startup_steps=N_BEFORE),
            direction="minimize" if config.objective == "steps" or goal.measure == "length" else "maximize",
            load_if_exists=True,
        )
        seed = len(study.trials) + 10_000 * job
        study.sampler = optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=N_RANDOM, multivariate=True, constant_liar=True
        )
    return study


def _check_same(study: optuna.Study, config: TuneConfig, space: SearchSpace) -> None:
    """Refuse a folder that holds another search."""
    asked = {name: getattr(config, name) for name in ("objective", "reach", "seeds")}
    asked["file"] = str((space.base, space.search))
    for name, value in study.user_attrs.get("asked", asked).items():
        if value != asked[name]:
            raise ValueError(f"{config.out} holds a search with another {name}. Give another --out.")
    study.set_user_attr("asked", asked)


def _backend(config: TuneConfig) -> contextlib.AbstractContextManager[Any]:
    """Where the jobs run: processes of this machine, or Ray's."""
    if config.cluster is None:
        return contextlib.nullcontext()
    connect(config.cluster)
    from ray.util.joblib import register_ray

    register_ray()  # type: ignore[no-untyped-call]  # Ray's
    backend: contextlib.AbstractContextManager[Any] = parallel_config("ray")
    return backend


def _work(config: TuneConfig, space: SearchSpace, job: int) -> None:
    """Try one set of settings after another until there are enough; one of several processes may do so."""
    console = Console(highlight=False, soft_wrap=True)
    goal = Goal.parsed(config.reach)
    study = _opened(config, goal, job)
    counted = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
    while len(study.get_trials(deepcopy=False, states=counted)) < config.trials:
        trial = study.ask(space.search)
        text = "stopped, for it is worse than the best"
        try:
            value = _mean_score(trial, config, space, goal)
            state = TrialState.PRUNED if value is None else TrialState.COMPLETE
            if value is not None:
                text = _shown(value, config)
        except Exception as error:
            value, state, text = None, TrialState.FAIL, f"failed: {error}"
            trial.set_user_attr("failed", str(error))
        study.tell(trial, value, state=state)
        settings = ", ".join(
            f"{name} {of:.3g}" if isinstance(of, float) else f"{name} {of}" for name, of in trial.params.items()
        )
        console.print(escape(f"Trial {trial.number + 1}: {text} ({settings})"))
        _check_failures(study, config)


def _mean_score(trial: optuna.Trial, config: TuneConfig, space: SearchSpace, goal: Goal) -> float | None:
    """Over the seeds; None where the trial proves worse than the best before them all."""
    scores = []
    for seed in range(config.seeds):
        folder = config.out / RUNS / f"{trial.number:04}" / str(seed)
        scores.append(score(space.config(space.values(trial.params), seed, folder), goal, config.objective))
        trial.report(scores[-1], len(scores))
        if trial.should_prune():
            return None
    return sum(scores) / len(scores)


def _check_failures(study: optuna.Study, config: TuneConfig) -> None:
    """End a search that leads nowhere."""
    trials = study.get_trials(deepcopy=False)
    failures = [trial.user_attrs["failed"] for trial in trials if "failed" in trial.user_attrs]
    completed = any(trial.state in (TrialState.COMPLETE, TrialState.PRUNED) for trial in trials)
    if len(failures) >= (max(N_RANDOM, config.trials) if completed else N_FAILED):
        raise ValueError(f"{len(failures)} trials failed. The last one: {failures[-1]}")


def score(run: TrainConfig, goal: Goal, objective: str) -> float:
    """Train once in a folder for this run alone, and say how good the run was, as `score_of` does."""
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
    """Logarithm of the primitive steps to the goal, or the measure's mean over the last tenth of training.

    Evaluations count, if the run made any; a run that never gets there counts with ``n_timesteps``.
    """
    curves = run.curves["eval"] or run.curves["rollout"]
    if goal.measure not in curves:
        raise ValueError(f"{run.folder} did not log {goal.measure}: choose --reach {', '.join(curves)}.")
    curve = curves[goal.measure]
    if objective == "end":
        return at_the_end(curve, n_timesteps)
    return math.log(max(1.0, learned_after(curve, goal) or n_timesteps))


def _shown(value: float, config: TuneConfig) -> str:
    return f"{math.exp(value):,.0f} primitive steps" if config.objective == "steps" else f"{value:.3g}"


def _draw(study: optuna.Study, config: TuneConfig, goal: Goal) -> None:
    """Optuna's own pictures, which are pyplot's."""
    unit = f"ln(primitive steps to {goal})" if config.objective == "steps" else goal.measure
    values = {trial.value for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))}
    for name, plot in PICTURES.items():
        if name == IMPORTANCES and (len(values) < 2 or len(study.best_params) < 2):
            continue  # there is nothing to compare
        with pyplot.rc_context(), warnings.catch_warnings():  # Optuna changes the style of all later pictures
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            warnings.simplefilter("ignore", UserWarning)  # of axes with a single value
            plot(study, target_name=unit)
            figure = pyplot.gcf()
            for axes in figure.axes:
                axes.xaxis.set_minor_formatter(NullFormatter())  # narrow logarithmic axes write numbers over another
            with atomic_write(config.out / name) as temporary:
                figure.savefig(temporary, dpi=DPI, format="png", bbox_inches="tight")
            pyplot.close(figure)
