"""``python -m experiments.deep.tune --algo ppo --arm stock|options --out FOLDER``.

Chooses the hyper-parameters of one side of the study: the same search space, the same number of trials and the same
seeds for stock Stable-Baselines3 and for the library with options. The search is that of ``sb3-options tune``; a trial
is the study's own tasks, some of which bring along options of their seed. Trials follow one another, and the tasks of a
seed run at the same time. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import tyro
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.trial import TrialState
from rich.console import Console
from rich.json import JSON

from experiments.common.machines import Machines
from experiments.common.seeds import Part, Result, run_parts, write_json
from experiments.common.study import show
from experiments.deep.agents import reached_at
from experiments.deep.conditions import train, train_source
from experiments.deep.search import Search, best_of, choices, opened, work
from experiments.deep.settings import DeepSettings
from experiments.deep.tasks import TASKS, Task

STEPS_AFTER = 1000
"""Training ends here, primitive steps after the first success: only steps to 90 % count."""

Space: TypeAlias = dict[str, BaseDistribution]

NET_ARCHS: dict[str, list[int]] = {"none": [], "64, 64": [64, 64], "256": [256]}
SPACES: dict[str, Space] = {
    "ppo": {
        "learning_rate": FloatDistribution(5e-4, 5e-3, log=True),
        "n_steps": choices((16, 32, 64)),
        "batch_size": choices((64, 128)),
        "n_epochs": choices((4, 8, 16)),
        "gae_lambda": choices((0.8, 0.9, 0.95, 0.98)),
        "ent_coef": FloatDistribution(3e-4, 3e-2, log=True),
        "normalize_advantage": choices((False, True)),
        "net_arch": choices(tuple(NET_ARCHS)),
    },
    "dqn": {
        "learning_rate": FloatDistribution(2e-4, 4e-3, log=True),
        "batch_size": choices((32, 64, 128)),
        "target_update_interval": choices((50, 100, 200, 500)),
        "exploration_fraction": choices((0.1, 0.2, 0.4)),
        "exploration_final_eps": choices((0.02, 0.05, 0.1)),
        "net_arch": choices(tuple(NET_ARCHS)),
    },
}
"""Of an algorithm; both sides share them."""

OF_OPTIONS: Space = {"max_option_exploration": choices((0.25, 0.5, 0.75))}


@dataclass(frozen=True)
class Tuning(Machines):
    """Choose the hyper-parameters of one side of the study.

    Attributes:
        out: Folder for tuned.json, the trials and the options brought along.
        algo: Of which algorithm.
        arm: Of which side.
        trials: How many sets of hyper-parameters are tried.
        seeds: Each is run on this many seeds, from 0, in every task, until it proves worse than the best.
    """

    out: Path
    algo: Literal["dqn", "ppo"] = "ppo"
    arm: Literal["stock", "options"] = "options"
    trials: int = 17
    seeds: int = 2

    @property
    def folder(self) -> Path:
        """Of this side."""
        return self.out / f"{self.algo}-{self.arm}"


def main(tuning: Tuning) -> None:
    """Try, and write and print what was best."""
    if tuning.arm == "options":
        _make_sources(tuning)
    search = Search(
        tuning.folder,
        {**SPACES[tuning.algo], **(OF_OPTIONS if tuning.arm == "options" else {})},
        partial(_scores, tuning),
        tuning.trials,
        asked={"seeds": tuning.seeds},
        shown=lambda score: f"{math.exp(score):,.0f} primitive steps",
    )
    study = opened(search)
    work(study, search, Console(highlight=False, soft_wrap=True))
    place, best = best_of(study, search)
    taken = [_steps_to_90(tuning, place, best, seed) for seed in range(tuning.seeds)]  # they are there
    states = [trial.state for trial in study.trials]
    content = {
        "command": f"python -m experiments.deep.tune --algo {tuning.algo} --arm {tuning.arm} --trials {tuning.trials} "
        f"--seeds {tuning.seeds}",
        "finished": states.count(TrialState.COMPLETE),
        "pruned": states.count(TrialState.PRUNED),
        "steps_to_90": {task: [of[task] for of in taken] for task in taken[0]},
        "best": best,
    }
    write_json(tuning.folder / "tuned.json", content)
    show(JSON.from_data(content))


def _scores(tuning: Tuning, place: str, proposed: dict[str, Any]) -> Iterator[float]:
    """Log of the steps to 90 %, in every task, seed after seed."""
    for seed in range(tuning.seeds):
        for steps in _steps_to_90(tuning, place, proposed, seed).values():
            yield math.log(max(steps, DeepSettings().evaluate_every))


def _steps_to_90(tuning: Tuning, place: str, proposed: dict[str, Any], seed: int) -> dict[str, int]:
    """By task; a run that never gets there counts with its whole length."""
    settings = _with(proposed, tuning)
    parts = []
    for (kind, env), task in TASKS.items():
        if kind != "deadline":  # that is a test of what was chosen
            options = _options(tuning, env) if kind == "transfer" and tuning.arm == "options" else None
            function = partial(_trained, task, tuning, settings, options)
            parts.append(Part(f"{kind}, {env}", function, tuning.folder / "runs" / place / f"{kind}-{env}"))
    found = run_parts(parts, [seed], settings=settings.of(tuning.algo, tuning.arm), on=tuning, description=place)
    return {name: of["steps_to_90"] for name, (of,) in found.items()}


def _trained(task: Task, tuning: Tuning, settings: DeepSettings, options: Path | None, seed: int) -> Result:
    brought = None if options is None else options / f"{seed}.safetensors"
    trained = train(task, tuning.algo, tuning.arm, settings, seed, options=brought, steps_after=STEPS_AFTER)
    return {"steps_to_90": reached_at(trained.result["steps"], trained.result["success"]) or task.n_timesteps}


def _with(proposed: dict[str, Any], tuning: Tuning) -> DeepSettings:
    """The study's settings with those that are proposed."""
    settings = DeepSettings()
    sides = getattr(settings, tuning.algo)
    own = {name: proposed[name] for name in SPACES[tuning.algo] if name != "net_arch"}
    own["policy_kwargs"] = {"net_arch": NET_ARCHS[proposed["net_arch"]]}
    changes: dict[str, Any] = {tuning.algo: {**sides, tuning.arm: {**sides[tuning.arm], **own}}}
    for name in OF_OPTIONS:
        if name in proposed:
            changes[name] = {**getattr(settings, name), tuning.algo: proposed[name]}
    return dataclasses.replace(settings, **changes)


def _options(tuning: Tuning, env: str) -> Path:
    """Folder of those that are brought along, a file a seed; on a cluster all machines share it."""
    return tuning.folder.absolute() / "sources" / env


def _make_sources(tuning: Tuning) -> None:
    """Options to bring along, from the old task, with the settings as they are before tuning."""
    parts = [
        Part(env, partial(_source, task, tuning, env), _options(tuning, env))
        for (kind, env), task in TASKS.items()
        if kind == "transfer"
    ]
    settings = DeepSettings().of(tuning.algo, "options")
    run_parts(parts, range(tuning.seeds), settings=settings, on=tuning, description="Options of the old task")


def _source(task: Task, tuning: Tuning, env: str, seed: int) -> Result:
    discovery = train_source(task, tuning.algo, "options", DeepSettings(), seed).discovery
    assert discovery is not None  # of this arm
    _options(tuning, env).mkdir(parents=True, exist_ok=True)
    discovery.bank.save(_options(tuning, env) / f"{seed}.safetensors")
    return {"subgoals": [[float(x) for x in d.subgoal] for d in discovery.discoveries]}


if __name__ == "__main__":
    main(tyro.cli(Tuning))
