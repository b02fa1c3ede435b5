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
        document: The page.
    """

    results: Path = Path("docs/results/random-walks.json")
    methods: Path = Path("docs/results/random-walks-methods.json")
    document: Path = Path("docs/studies/random-walks.md")


def main(report: Report) -> None:
    """Read, and fill in."""
    bags, methods = (json.loads(path.read_text(encoding="utf-8")) for path in (report.results, report.methods))
    fill(report.document, {"subgoals": table(bags["summary"]), "methods": table(methods["summary"], "method")})


def table(summary: Mapping[str, Any], compared: str = "bags") -> str:
    """A row for each task and arm."""
    rows = [f"| | {compared} | first subgoals | all subgoals | median episode of the first |", "|---|---|---|---|---|"]
    for name, row in summary.items():
        task, arm = name.split(": ")
        rows.append(f"| {task} | {arm} | {_share(row['first'])} | {_share(row['all'])} | {_episode(row)} |")
    return "\n".join(rows)


def _episode(row: Mapping[str, Any]) -> str:
    return "–" if row["median_episode"] is None else f"{row['median_episode']:.0f}"


def _share(share: Mapping[str, Any]) -> str:
    return f"{share['n_bottlenecks']} of {share['n']} ({share['low']:.2f} to {share['high']:.2f})"


if __name__ == "__main__":
    main(tyro.cli(Report))
