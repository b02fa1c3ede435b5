"""``python -m experiments.paper FIGURE|all --runs 30 --out FOLDER``: a picture for each figure, and results.json.

Interrupted, it goes on where it was: every finished group of a seed is kept below ``FOLDER/groups``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import tyro
from rich.table import Table

from experiments.common.documents import settings_lines
from experiments.common.seeds import Part, Result, run_parts
from experiments.common.study import Flags, show, write
from experiments.paper import conditions
from experiments.paper.claims import Claim, claims_of
from experiments.paper.plots import draw
from experiments.paper.settings import PaperSettings
from experiments.paper.summary import numbers_of

FigureName = Literal["figure1", "figure2", "figure3", "figure4", "figure5", "figure6", "controls", "negatives"]

GROUPS: dict[FigureName, tuple[str, ...]] = {
    "figure1": ("learning",),
    "figure2": ("learning",),
    "figure3": ("learning",),
    "figure4": ("learning", "controls"),
    "figure5": ("learning", "transfer"),
    "figure6": ("learning", "transfer", "reuse"),
    "controls": ("learning", "controls"),
    "negatives": ("learning", "negatives"),
}
"""What each figure is made from. A group is run once, however many figures need it."""

IN_ORDER = (("learning",), ("controls", "transfer", "reuse", "negatives"))
"""What starts from the option and the values of ``learning`` comes after it; the longest first, in one pool."""

DPI = 90


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Reproduce the gridworld figures of McGovern & Barto (2001).

    Attributes:
        figure: Which one, or all.
        settings: Of the task, of learning and of discovery.
    """

    figure: tyro.conf.Positional[Literal["all"] | FigureName]
    first_seed: int = 4000
    settings: PaperSettings = field(default_factory=PaperSettings)


def main(study: Study) -> None:
    """Run what the figures need, and write and print what was found."""
    began = time.perf_counter()
    figures: list[FigureName] = list(GROUPS) if study.figure == "all" else [study.figure]
    needed = {group for figure in figures for group in GROUPS[figure]}
    groups: dict[str, list[Result]] = {}
    for stage in IN_ORDER:
        groups |= _run(study, [group for group in stage if group in needed])
    numbers: dict[str, dict[str, Any]] = {figure: numbers_of(figure, groups) for figure in figures}
    claims = claims_of(numbers)
    results: dict[str, Any] = {
        "command": f"python -m experiments.paper {study.figure} --runs {study.runs} --first-seed {study.first_seed}",
        "n_runs": study.runs,
        "seconds": round(time.perf_counter() - began, 1),
        "settings": study.settings.described(),
        "claims": {claim.name: claim._asdict() for claim in claims},
        "figures": numbers,
    }
    write(study.out, results, {figure: draw(figure, groups) for figure in figures}, dpi=DPI)
    closing = f"{study.runs} runs in {results['seconds']:.0f} s. Results and pictures: {study.out}"
    show(_table(claims), *settings_lines(results["settings"]), closing)


def _run(study: Study, groups: list[str]) -> dict[str, list[Result]]:
    settings, artifacts = study.settings, study.out / "groups" / "learning" / "artifacts"
    functions: dict[str, Callable[[int], Result]] = {
        "learning": partial(conditions.learning, settings, artifacts),
        "controls": partial(conditions.controls, settings),
        "transfer": partial(conditions.transfer, settings, artifacts),
        "reuse": partial(conditions.reuse, settings, artifacts),
        "negatives": partial(conditions.negatives, settings),
    }
    return run_parts(
        [Part(group, functions[group], study.out / "groups" / group) for group in groups],
        study.seeds(),
        settings=settings.described(),
        on=study,
        description=", ".join(groups).capitalize(),
    )


def _table(claims: list[Claim]) -> Table:
    table = Table("what", "number", "95 % interval", "bar", "reached")
    for c in claims:
        value = "–" if c.value is None else f"{c.value:.3g}"
        interval = "" if c.low is None else f"{c.low:.3g} to {c.high:.3g}"
        table.add_row(c.name, value, interval, c.bar, "yes" if c.reached else "NO")
    return table


if __name__ == "__main__":
    main(tyro.cli(Study))
