"""``python -m experiments.methods.report``: fills in the tables of docs/studies/methods.md."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.common.documents import fill, number


@dataclass(frozen=True)
class Report:
    """Fill in the command and a table for each task and learner that was run.

    Attributes:
        results: What the race wrote.
        tuned: What it wrote with ``--settings tuned``.
        document: The page.
    """

    results: Path = Path("docs/results/methods.json")
    tuned: Path = Path("docs/results/methods-tuned.json")
    document: Path = Path("docs/studies/methods.md")


def main(report: Report) -> None:
    """Read, and fill in."""
    parts = parts_of(json.loads(report.results.read_text(encoding="utf-8")))
    tuned = parts_of(json.loads(report.tuned.read_text(encoding="utf-8")))
    fill(report.document, {**parts, "tuned-command": tuned["command"], "tuned": tuned["overview"]})


def parts_of(results: Mapping[str, Any]) -> dict[str, str]:
    """What stands between the marks of the page."""
    tables = [
        f"**{task}, {learner}**\n\n{table(summary)}"
        for task, of in results["summary"].items()
        for learner, summary in of.items()
    ]
    return {
        "command": f"`{results['command']}`",
        "overview": overview({task: of["macroq"] for task, of in results["summary"].items() if "macroq" in of}),
        "race": "\n\n".join(tables),
    }


def overview(summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """All tasks of one learner: steps in the same task and with the goal moved, of the primitives'; * where some never.

    Args:
        summaries: By task, then by entrant.
    """
    entrants = list(next(iter(summaries.values()), {}))
    rows = [f"| | {' | '.join(summaries)} |", "|---" * (len(summaries) + 1) + "|"]
    for entrant in entrants:
        cells = [_both(of[entrant]) for of in summaries.values()]
        if any(cells):
            rows.append(f"| {entrant} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _both(of: Mapping[str, Any]) -> str:
    """As "0.83, 0.20"; empty for primitives themselves."""
    phases = [of["same"], of["moved"]]
    if any(each["of_primitives"] is None for each in phases):
        return ""
    return ", ".join(f"{each['of_primitives']['mean']:.2f}{'*' if each['never'] else ''}" for each in phases)


def table(summary: Mapping[str, Any]) -> str:
    """A row for each entrant; the steps of primitives alone stand in the last one."""
    rows = [
        "| | subgoals at bottlenecks | runs that reach them | steps, same task | steps, goal moved | discovery, s |",
        "|---|---|---|---|---|---|",
    ]
    for entrant, of in summary.items():
        cells = [number(of["near"]) or "–", number(of["reached"]) or "–"]
        for phase in ("same", "moved"):
            ratio, never = of[phase]["of_primitives"], of[phase]["never"]
            text = number(ratio) or f"{number(of[phase]['steps'], form='{:,.0f}')} steps"
            cells.append(text + (f", {never} never" if never else ""))
        cells.append(f"{of['discovery_seconds']['mean']:.2f}")
        rows.append(f"| {entrant} | {' | '.join(cells)} |")
    return "\n".join(rows)


if __name__ == "__main__":
    main(tyro.cli(Report))
