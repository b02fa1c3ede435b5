"""``python -m experiments.deep --task same|transfer --env … --algo dqn,ppo --runs 20 --out FOLDER``.

Trains every algorithm in every environment three times a seed: stock Stable-Baselines3, with options that it discovers
(or brings along, in transfer), and with random repeats in their place. Writes ``results.json`` and ``curves.png``.
Interrupted, it goes on where it was: every finished run is kept below ``FOLDER/runs``.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from experiments.common.seeds import Part, run_parts, write_json
from experiments.deep.agents import ALGORITHMS, ARMS, Arm, run
from experiments.deep.plots import draw
from experiments.deep.settings import DeepSettings
from experiments.deep.summary import summarise
from experiments.deep.tasks import TASKS

DPI = 100


@dataclass(frozen=True)
class Study:
    """Does an agent learn faster with options that it discovers?

    Attributes:
        out: Folder for results.json, curves.png and one file per finished run.
        task: Learn one task from nothing, or one whose goal has moved, with the options of the old one.
        env: Which gridworlds, with commas between; by default all that have the task.
        algo: Which algorithms, with commas between: dqn and ppo, which with options keep to their initiation sets
            (OptionDQN, MaskablePPO); dqn-unmasked, ppo-unmasked and qrdqn, which do not.
        arms: What is compared, with commas between: stock, options, repeats.
        runs: Number of seeds.
        control_runs: Seeds of the random repeats; by default as many.
        first_seed: Seeds count up from here. Settings were chosen on seeds 0 to 99, so none of these.
        jobs: Processes; by default one a core.
        settings: Of the algorithms and of discovery.
    """

    out: Annotated[Path, tyro.conf.arg(name="out")]
    task: Literal["same", "transfer"] = "same"
    env: str = ""
    algo: str = "dqn,ppo"
    arms: str = "stock,options,repeats"
    runs: int = 20
    control_runs: int | None = None
    first_seed: int = 2000
    jobs: int | None = None
    settings: DeepSettings = field(default_factory=DeepSettings)

    def __post_init__(self) -> None:
        """Refuse what there is not, by name."""
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

    def chosen(self, name: str) -> list[str]:
        """The values of a flag that has commas between them."""
        values = [value.strip() for value in getattr(self, name).split(",") if value.strip()]
        return values or [env for task, env in TASKS if task == self.task]


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
    study.out.mkdir(parents=True, exist_ok=True)
    draw(study.task, runs, lengths).savefig(study.out / "curves.png", dpi=DPI)
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
    }
    write_json(study.out / "results.json", content)
    _print(numbers, study)


def _run(study: Study, arm: Arm) -> dict[tuple[str, str], Any]:
    n = study.runs if arm != "repeats" or study.control_runs is None else study.control_runs
    found: dict[tuple[str, str], Any] = {}
    for algo in study.chosen("algo"):
        parts = []
        for env in study.chosen("env"):
            folder = study.out / "runs" / f"{env}-{algo}-{arm}"
            parts.append(Part(env, partial(run, TASKS[study.task, env], algo, arm, study.settings, folder), folder))
        results = run_parts(
            parts,
            range(study.first_seed, study.first_seed + n),
            settings={**study.settings.of(algo, arm), "task": study.task, "worlds": _worlds(study.task)},
            jobs=study.jobs,
            description=f"{study.task}, {algo}, {arm}",
        )
        found |= {(env, algo): of for env, of in results.items()}
    return found


def _worlds(task: str) -> dict[str, Any]:
    return {env: dataclasses.asdict(world) for (kind, env), world in TASKS.items() if kind == task}


def _print(numbers: dict[str, Any], study: Study) -> None:
    table = Table("", "runs", "steps to 90 %", "of stock", "Pr(faster)", "final steps", "of stock", "never")
    for env, by_algorithm in numbers.items():
        for algo, arms in by_algorithm.items():
            for arm, of in arms.items():
                table.add_row(
                    f"{algo} {env} {arm}",
                    str(of["n_runs"]),
                    _text(of["steps_to_90"], "{:,.0f}"),
                    _text(of.get("steps_to_90_of_stock")),
                    _text(of.get("probability_of_improvement")),
                    _text(of["final_steps"], "{:.1f}"),
                    _text(of.get("final_steps_of_stock"), "{:.3f}"),
                    str(of["never"]),
                )
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    console.print(
        "Steps to 90 %: interquartile means with 95 % stratified bootstrap intervals; a run that never gets there "
        "counts with its whole length."
    )
    console.print(f"Results: {study.out / 'results.json'}, {study.out / 'curves.png'}")


def _text(interval: dict[str, float] | None, form: str = "{:.2f}") -> str:
    if interval is None:
        return ""
    mean, low, high = (form.format(interval[key]) for key in ("mean", "low", "high"))
    return f"{mean} ({low} to {high})"


if __name__ == "__main__":
    main(tyro.cli(Study))
