"""``python -m experiments.pioneer figure7|figure8|learning|transfer|dqn|all --runs 30 --out FOLDER``.

A picture for each figure, and results.json. Interrupted, it goes on where it was: every finished run of a seed is kept
below ``FOLDER/groups``, and what two figures share is run once.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import tyro
from rich.table import Table

from experiments.common.documents import settings_lines
from experiments.common.seeds import Result, run_seeds
from experiments.common.study import Flags, show, write
from experiments.pioneer import conditions
from experiments.pioneer.plots import draw
from experiments.pioneer.settings import MAIN_TASK, PioneerSettings
from experiments.pioneer.summary import numbers_of
from sb3_options.runs.config import TrainConfig, configure

FigureName = Literal["figure7", "figure8", "learning", "transfer", "dqn"]

GROUPS: dict[FigureName, tuple[str, ...]] = {
    "figure7": (),
    "figure8": ("learning",),
    "learning": ("learning",),
    "transfer": ("learning", "transfer"),
    "dqn": ("dqn",),
}
"""What each figure is made from; later groups take up what earlier ones left."""


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """The simulated robot of McGovern & Barto (2001), §7.

    Attributes:
        figure: Which one, or all.
        transfer_runs: Number of seeds for the transfer tasks, which take longer; by default all of them.
        dqn_runs: Number of seeds for DQN, which takes longest.
        settings: Of the task, of learning and of discovery.
        dqn: Of training DQN; seed, folder, `discover` and `progress` are the study's.
    """

    figure: tyro.conf.Positional[Literal["all"] | FigureName]
    transfer_runs: int | None = None
    dqn_runs: int = 5
    settings: PioneerSettings = field(default_factory=PioneerSettings)
    dqn: TrainConfig = field(default_factory=lambda: configure(env=MAIN_TASK))


def main(study: Study) -> None:
    """Run what the figures need, and write and print what was found."""
    began = time.perf_counter()
    figures: list[FigureName] = list(GROUPS) if study.figure == "all" else [study.figure]
    groups: dict[str, list[Result]] = {}
    for name in ("learning", "transfer", "dqn"):
        if any(name in GROUPS[figure] for figure in figures):
            groups[name] = _run(study, name)
    numbers: dict[str, dict[str, Any]] = {figure: numbers_of(figure, groups) for figure in figures if GROUPS[figure]}
    results: dict[str, Any] = {
        "command": f"python -m experiments.pioneer {study.figure} --runs {study.runs} --first-seed {study.first_seed}"
        f" --transfer-runs {study.transfer_runs or study.runs} --dqn-runs {study.dqn_runs}",
        "n_runs": study.runs,
        "settings": study.settings.described(),
        "dqn_settings": json.loads(json.dumps(dataclasses.asdict(study.dqn), default=str)),
        "figures": numbers,
    }
    write(study.out, results, {figure: draw(figure, groups) for figure in figures})
    if numbers:
        show(_table(numbers), *settings_lines(results["settings"]))
    show(f"{time.perf_counter() - began:.0f} s. Results and pictures: {study.out}")


def _run(study: Study, name: str) -> list[Result]:
    settings = study.settings
    transfer_runs = min(study.runs, study.transfer_runs or study.runs)
    runs = {"learning": study.runs, "transfer": transfer_runs, "dqn": study.dqn_runs}[name]
    artifacts = study.out / "groups" / ("dqn" if name == "dqn" else "learning") / "artifacts"
    functions: dict[str, Callable[[int], Result]] = {
        "learning": partial(conditions.learning, settings, artifacts),
        "transfer": partial(conditions.transfer, settings, artifacts),
        "dqn": partial(conditions.dqn, study.dqn, artifacts),
    }
    return run_seeds(
        functions[name],
        study.seeds(runs),
        study.out / "groups" / name,
        settings=dataclasses.asdict(study.dqn) if name == "dqn" else settings.described(),
        on=study,
        description=name.capitalize(),
    )


def _table(numbers: dict[str, dict[str, Any]]) -> Table:
    table = Table("figure", "what", "number", "95 % interval", "bar", "reached")
    for figure, values in numbers.items():
        for name, value in _intervals(values):
            reached = {True: "yes", False: "NO", None: ""}[value.get("reached")]
            interval = f"{value['low']:.3g} to {value['high']:.3g}"
            table.add_row(figure, name, f"{value['mean']:.3g}", interval, str(value.get("bar", "")), reached)
    return table


def _intervals(values: dict[str, Any], prefix: str = "") -> list[tuple[str, dict[str, Any]]]:
    """Everything in nested numbers that has an interval, with its path."""
    found: list[tuple[str, dict[str, Any]]] = []
    for name, value in values.items():
        if isinstance(value, dict):
            found += [(prefix + name, value)] if "low" in value else _intervals(value, f"{prefix}{name}.")
    return found


if __name__ == "__main__":
    main(tyro.cli(Study))
