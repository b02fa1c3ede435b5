"""``python -m experiments.random_walks.report``: fills in the table of docs/studies/random-walks.md."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.common.documents import fill


@dataclass(frozen=True)
class Report:
    """Fill in the tables.

    Attributes:
        results: What the study wrote.
        methods: What it wrote with ``--compare methods``.
        waiting: What it wrote with ``--compare waiting``.
        noise: What it wrote with ``--compare waiting --noise 0.3``.
        document: The page.
    """

    results: Path = Path("docs/results/random-walks.json")
    methods: Path = Path("docs/results/random-walks-methods.json")
    waiting: Path = Path("docs/results/random-walks-waiting.json")
    noise: Path = Path("docs/results/random-walks-noise.json")
    document: Path = Path("docs/studies/random-walks.md")


def main(report: Report) -> None:
    """Read, and fill in."""
    fill(report.document, parts_of(*map(_summary, (report.results, report.methods, report.waiting, report.noise))))


def _summary(path: Path) -> dict[str, Any]:
    """That of a results file."""
    summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["summary"]
    return summary


def parts_of(
    bags: Mapping[str, Any], methods: Mapping[str, Any], waiting: Mapping[str, Any], noise: Mapping[str, Any]
) -> dict[str, str]:
    """The tables, by their marks."""
    waits = "first search after, and persistence"
    return {
        "subgoals": table(bags),
        "methods": table(methods, "method"),
        "waiting": table(waiting, waits),
        "noise": table(noise, waits),
    }


def table(summary: Mapping[str, Any], compared: str = "bags") -> str:
    """A row for each task and arm; how many instances are bottlenecks where bags are compared."""
    headings = ["", compared, "first subgoals", "all subgoals", "median episode of the first"]
    headings += ["instances in positive bags"] if compared == "bags" else []
    rows = [f"| {' | '.join(headings)} |".replace("|  |", "| |"), "|---" * len(headings) + "|"]
    for name, row in summary.items():
        cells = [*name.split(": "), _share(row["first"]), _share(row["all"]), _episode(row)]
        if compared == "bags":
            cells.append("{n_bottlenecks} of {n}".format(**row["instances"]))
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def _episode(row: Mapping[str, Any]) -> str:
    return "–" if row["median_episode"] is None else f"{row['median_episode']:.0f}"


def _share(share: Mapping[str, Any]) -> str:
    return f"{share['n_bottlenecks']} of {share['n']} ({share['low']:.2f} to {share['high']:.2f})"


if __name__ == "__main__":
    main(tyro.cli(Report))
