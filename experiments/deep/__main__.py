"""``python -m experiments.deep --task same|transfer|deadline --env … --algo dqn,ppo --runs 20 --out FOLDER``.

Trains every algorithm in every environment once an arm and seed: stock Stable-Baselines3, with options that it
discovers (or brings along, in transfer), with random repeats in their place, and what else ``--arms`` names. Writes
``results.json``, ``curves.png`` and, over the seconds of training, ``seconds.png``.
Interrupted, it goes on where it was: every finished run is kept below ``FOLDER/runs``.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, cast

import tyro
from rich.table import Table

from experiments.common.documents import number
from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, show, write
from experiments.deep.agents import ALGORITHMS
from experiments.deep.arms import ARMS, Arm, has_arm
from experiments.deep.conditions import run
from experiments.deep.plots import draw, draw_seconds
from experiments.deep.settings import DeepSettings
from experiments.deep.summary import summarise
from experiments.deep.tasks import TASKS


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Does an agent learn faster with options that it discovers?

    Attributes:
        task: Learn one task from nothing; or one whose goal has moved, with the options of the old one; or the same
            with a deadline that random walks hardly ever keep.
        env: Which gridworlds, with commas between; by default all that have the task.
        algo: Which algorithms, with commas between: dqn and ppo, which with options keep to their initiation sets
            (OptionDQN, MaskablePPO); dqn-unmasked, ppo-unmasked and qrdqn, which do not.
        arms: What is compared, with commas between: stock, carried (the network of the old task), n-step (returns over
            10 steps, DQN only), count-bonus and rnd (intrinsic rewards); options, options-n-step, options-bonus (of
            state counts); repeats.
        control_runs: Seeds of the random repeats; by default as many.
        settings: Of the algorithms and of discovery.
    """

    task: Literal["same", "transfer", "deadline"] = "same"
    env: str = ""
    algo: str = "dqn,ppo"
    arms: str = "stock,options,repeats"
    runs: int = 20
    first_seed: int = 2000
    control_runs: int | None = None
    settings: DeepSettings = field(default_factory=DeepSettings)

    def __post_init__(self) -> None:
        """Refuse what there is not, by name."""
        super().__post_init__()
        known: dict[str, list[str]] = {
            "env": [env for task, env in TASKS if task == self.task],
            "algo": list(ALGORITHMS),
            "arms": list(ARMS),
        }
        for name, possible in known.items():
            for value in self.chosen(name):
                if value not in possible:
                    raise SystemExit(
                        f"--{name}: there is no {value!r} for --task {self.task}, choose from {', '.join(possible)}."
                    )
        if not any(has_arm(algo, cast("Arm", arm)) for algo in self.chosen("algo") for arm in self.chosen("arms")):
            raise SystemExit("--arms: n-step returns need an algorithm with a replay buffer, for instance --algo dqn.")

    def chosen(self, name: str) -> list[str]:
        """The values of a flag that has commas between them."""
        values = [value.strip() for value in getattr(self, name).split(",") if value.strip()]
        return values or ([env for task, env in TASKS if task == self.task] if name == "env" else [])


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    began = time.perf_counter()
    environments, algorithms = study.chosen("env"), study.chosen("algo")
    runs: dict[tuple[str, str], dict[str, Any]] = {(e, a): {} for e in environments for a in algorithms}
    for arm in ARMS:
        if arm in study.chosen("arms"):
            for key, results in _run(study, arm).items():
                runs[key][arm] = results
    lengths = {env: TASKS[study.task, env].n_timesteps for env in environments}
    numbers = {env: {algo: summarise(runs[env, algo], lengths[env]) for algo in algorithms} for env in environments}
    command = (
        f"python -m experiments.deep --task {study.task} --env {','.join(environments)} --algo {','.join(algorithms)} "
        f"--arms {study.arms} --runs {study.runs} --first-seed {study.first_seed}"
    )
    if study.control_runs is not None:
        command += f" --control-runs {study.control_runs}"
    content = {
        "command": " ".join([command, *study.settings.switched()]),
        "n_runs": study.runs,
        "seconds": round(time.perf_counter() - began, 1),
        "settings": dataclasses.asdict(study.settings),
        "tasks": {env: dataclasses.asdict(TASKS[study.task, env]) for env in environments},
        "results": numbers,
        "runs": {env: {algo: _plain(runs[env, algo]) for algo in algorithms} for env in environments},
    }
    write(study.out, content, {"curves": draw(study.task, runs, lengths), "seconds": draw_seconds(study.task, runs)})
    show(
        _table(numbers),
        "Steps to 90 %: interquartile means with 95 % stratified bootstrap intervals; a run that never gets there "
        "counts with its whole length.",
        f"Results: {study.out / 'results.json'}, {study.out / 'curves.png'}, {study.out / 'seconds.png'}",
    )


def _plain(arms: dict[str, Any]) -> dict[str, Any]:
    """What the numbers can be worked out from again, without the curves' lengths."""
    return {arm: [{k: v for k, v in run.items() if k != "length"} for run in of] for arm, of in arms.items()}


def _run(study: Study, arm: Arm) -> dict[tuple[str, str], Any]:
    n = study.control_runs if arm == "repeats" else None
    found: dict[tuple[str, str], Any] = {}
    for algo in filter(lambda algo: has_arm(algo, arm), study.chosen("algo")):
        parts = []
        for env in study.chosen("env"):
            folder = study.out / "runs" / f"{env}-{algo}-{arm}"
            parts.append(Part(env, partial(run, TASKS[study.task, env], algo, arm, study.settings, folder), folder))
        results = run_parts(
            parts,
            study.seeds(n),
            settings={**study.settings.of(algo, arm), "task": study.task, "worlds": _worlds(study.task)},
            on=study,
            description=f"{study.task}, {algo}, {arm}",
        )
        found |= {(env, algo): of for env, of in results.items()}
    return found


def _worlds(task: str) -> dict[str, Any]:
    return {env: dataclasses.asdict(world) for (kind, env), world in TASKS.items() if kind == task}


def _table(numbers: dict[str, Any]) -> Table:
    table = Table("", "runs", "steps to 90 %", "of stock", "Pr(faster)", "final steps", "of stock", "never")
    for env, by_algorithm in numbers.items():
        for algo, arms in by_algorithm.items():
            for arm, of in arms.items():
                table.add_row(
                    f"{algo} {env} {arm}",
                    str(of["n_runs"]),
                    number(of["steps_to_90"], form="{:,.0f}"),
                    number(of.get("steps_to_90_of_stock")),
                    number(of.get("probability_of_improvement")),
                    number(of["final_steps"], form="{:.1f}"),
                    number(of.get("final_steps_of_stock"), form="{:.3f}"),
                    str(of["never"]),
                )
    return table


if __name__ == "__main__":
    main(tyro.cli(Study))
