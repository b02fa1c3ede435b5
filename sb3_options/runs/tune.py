"""Searches for settings with Optuna: TPE proposes, and every trial trains on the same seeds."""

import contextlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from joblib import Parallel, delayed
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import MaxTrialsCallback
from optuna.trial import Trial, TrialState
from rich.console import Console
from rich.markup import escape

from sb3_options.runs import config as configs
from sb3_options.runs import yaml_file
from sb3_options.runs.commands import TuneConfig
from sb3_options.runs.compare import Goal, read_run
from sb3_options.runs.config import IMPORTING, TrainConfig
from sb3_options.runs.training import train

BEST = "best.yml"
JOURNAL = "trials.log"
RUNS = "runs"
LOG = "output.txt"


class SearchSpace(NamedTuple):
    """Fixed settings and distributions of varied ones, by name, such as ``discovery.decay`` in a group."""

    file: Path
    base: dict[str, Any]
    search: dict[str, BaseDistribution]

    def config(self, proposed: Mapping[str, Any], seed: int, folder: Path) -> TrainConfig:
        """Return the configuration of a run, whose run folder will be in ``folder``."""
        read = {name: json.loads(v) if isinstance(v, str) else v for name, v in proposed.items()}
        own = {"seed": seed, "tensorboard_log": str(folder), "progress": False, "checkpoint_freq": 0}
        return configs.build({**self.base, **read, **own}, self.file)


def read_space(path: Path, trusted: Mapping[str, str | None]) -> SearchSpace:
    """Read a file with ``base`` and ``search``; ``trusted`` settings of the command line may import modules."""
    content = yaml_file.read_mapping(path)
    base, search = content.get("base", {}), content.get("search")
    if not (content.keys() <= {"base", "search"} and isinstance(base, dict) and isinstance(search, dict) and search):
        raise ValueError(f"{path}: write `base:` and `search:`, each with `name: value` lines, and nothing else.")
    if fixed := search.keys() & {*IMPORTING, "seed", "tensorboard_log"}:
        raise ValueError(f"{path}: {min(fixed)} cannot be varied.")
    distributions = {name: _distribution(path, name, of) for name, of in search.items()}
    space = SearchSpace(path, configs.with_trusted(base, trusted, path), distributions)
    for end in (0, -1):  # check names and both ends
        ends = {
            n: d.choices[end] if isinstance(d, CategoricalDistribution) else (d.low, d.high)[end]
            for n, d in distributions.items()
        }
        space.config(ends, 0, Path("runs"))
    return space


def _distribution(path: Path, name: str, of: Any) -> Any:
    try:
        if isinstance(of, list):
            return CategoricalDistribution([json.dumps(value) for value in of])  # Optuna hashes values
        whole = isinstance(of["low"], int) and isinstance(of["high"], int)
        return IntDistribution(**of) if whole else FloatDistribution(**of)
    except (TypeError, ValueError, KeyError) as error:
        example = "{low: 0.0001, high: 0.01, log: true} or a list of values"
        raise ValueError(f"{path}: {name} takes {example}, got {of!r}: {error}") from error


def tune(config: TuneConfig, console: Console) -> TrainConfig:
    """Search, write ``best.yml``, and return the best configuration."""
    goal = Goal.parsed(config.reach)
    space = read_space(config.space, config.trusted())
    config.out.mkdir(parents=True, exist_ok=True)
    study = _opened(config.out, 0)
    asked = [config.reach, config.seeds, str(space[1:])]
    if study.user_attrs.get("asked", asked) != asked:
        raise ValueError(f"{config.out} holds another search: its file, goal or seeds differ. Give another --out.")
    study.set_user_attr("asked", asked)
    for cut_off in study.get_trials(states=(TrialState.RUNNING,)):
        study.enqueue_trial(cut_off.params)
        study.tell(cut_off.number, state=TrialState.FAIL)
    Parallel(n_jobs=config.jobs)(delayed(_search)(config, space, goal, job) for job in range(config.jobs))
    best = space.config(study.best_params, 0, Path("runs"))
    configs.save(best, config.out / BEST)
    console.print(
        f"Trial {study.best_trial.number + 1} of {len(study.trials)} is the best, "
        f"{math.exp(study.best_value):,.0f} primitive steps. The best of many is better on these seeds than on others: "
        f"judge {escape(str(config.out / BEST))} with --config on --seed {config.seeds} and more."
    )
    return best


def _opened(folder: Path, job: int) -> optuna.Study:
    """Open the search in a folder, or a new one. Each job and each continued search draws other settings."""
    storage = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
    study = optuna.create_study(storage=storage, study_name="settings", load_if_exists=True)
    study.sampler = optuna.samplers.TPESampler(seed=len(study.trials) + 10_000 * job, multivariate=True)
    return study


def _search(config: TuneConfig, space: SearchSpace, goal: Goal, job: int) -> None:
    """Try one set of settings after another until there are enough; several processes may do so at once."""

    def mean_score(trial: Trial) -> float:
        proposed = {name: trial._suggest(name, of) for name, of in space.search.items()}
        folder = config.out / RUNS / f"{trial.number:04}"
        runs = [space.config(proposed, seed, folder / str(seed)) for seed in range(config.seeds)]
        return sum(score(run, goal) for run in runs) / len(runs)

    study = _opened(config.out, job)
    if len(study.get_trials(states=(TrialState.COMPLETE,))) < config.trials:
        study.optimize(mean_score, callbacks=[MaxTrialsCallback(config.trials, states=(TrialState.COMPLETE,))])


def score(run: TrainConfig, goal: Goal) -> float:
    """Train once, in a folder for this run alone. Return the log of the primitive steps to the goal, or of all."""
    run.tensorboard_log.mkdir(parents=True, exist_ok=True)
    log = (run.tensorboard_log / LOG).open("w", encoding="utf-8")
    with log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        trained = train(run)
    if trained.signal is not None:
        raise KeyboardInterrupt
    curves = read_run(trained.folder).curves
    curve = (curves["eval"] or curves["rollout"]).get(goal.measure)
    if curve is None:
        raise ValueError(f"{trained.folder} did not log {goal.measure}: choose another --reach.")
    return math.log(max(1.0, goal.reached(curve) or run.n_timesteps))
