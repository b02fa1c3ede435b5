"""``python -m experiments.deep.report docs/results/deep-same-ppo.json …``: puts the numbers of a study in place.

No number is copied by hand.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.common.documents import fill, number
from experiments.deep.arms import OPTIONS
from experiments.deep.plots import LABELS

COLUMNS = (
    "",
    "runs",
    "with an option",
    "steps to 90 %",
    "of stock",
    "Pr(faster)",
    "area, difference",
    "final steps",
    "of stock",
    "never",
)
PARTS = ("transfer", "same", "control")


@dataclass(frozen=True)
class Report:
    """Put the numbers of the study into their document.

    Attributes:
        results: What the study wrote, one file or several.
        document: Markdown with the markers.
    """

    results: tyro.conf.Positional[tuple[Path, ...]]
    document: Path = Path("docs/studies/deep.md")


def main(report: Report) -> None:
    """Read, and fill in."""
    studies = [json.loads(path.read_text(encoding="utf-8")) for path in report.results]
    parts = {}
    for part in PARTS:
        of_part = [study for study in studies if part_of(study["command"]) == part]
        parts[part] = "\n\n".join(f"`{study['command']}`\n\n{table(study)}" for study in of_part)
    fill(report.document, parts)


def part_of(command: str) -> str:
    """Where in the document the results of a command belong."""
    if "--settings.both-as " in command:
        return "control"
    return "transfer" if "--task transfer " in command else "same"


def table(study: dict[str, Any]) -> str:
    """One row for each algorithm, environment and arm."""
    return "\n".join(["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|", *rows(study)])


def rows(study: dict[str, Any]) -> Iterator[str]:
    """Of one study."""
    for env, algorithms in study["results"].items():
        for algo, arms in algorithms.items():
            for arm, of in arms.items():
                cells = [
                    f"{algo.upper()}, {env}: {LABELS[arm]}",
                    str(of["n_runs"]),
                    str(of["with_option"]) if arm in OPTIONS else "",
                    number(of["steps_to_90"], form="{:,.0f}"),
                    number(of.get("steps_to_90_of_stock")),
                    number(of.get("probability_of_improvement")),
                    number(of.get("area_difference")),
                    "{mean:.1f}".format(**of["final_steps"]),
                    number(of.get("final_steps_of_stock"), form="{:.3f}"),
                    str(of["never"]),
                ]
                yield "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main(tyro.cli(Report))
