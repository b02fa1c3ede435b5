"""``python -m experiments.methods.report``: fills in the tables of docs/studies/methods.md."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.common.documents import fill, number
from experiments.methods.entrants import NONE

LEFT_OUT = (
    "tuned-race", "tuned-random", "robot-overview", "robot-random", "filtered-random", "filtered-race",
    "ppo-random", "ppo-race", "dqn-random", "dqn-race",
)  # fmt: skip
"""Tables that the page does without."""

LABELS = {"macroq": "MacroQ", "ppo": "MaskablePPO", "dqn": "OptionDQN"}

LEARNED = ("", "ppo-", "dqn-")
"""Whose means over tasks stand beside each other."""

MANY = 0.25
"""If this share of the runs never met the criterion, a ratio of steps is a bound."""


@dataclass(frozen=True)
class Report:
    """Fill in the commands and a table for each task and learner that was run.

    Attributes:
        results: What the race wrote.
        tuned: What it wrote with ``--settings tuned``.
        ppo: What it wrote with ``--learners ppo``.
        dqn: What it wrote with ``--learners dqn``.
        robot: What it wrote with ``--tasks Pioneer``.
        filtered: What it wrote with ``--methods`` that name ``random-filtered``.
        document: The page.
    """

    results: Path = Path("docs/results/methods.json")
    tuned: Path = Path("docs/results/methods-tuned.json")
    ppo: Path = Path("docs/results/methods-ppo.json")
    dqn: Path = Path("docs/results/methods-dqn.json")
    robot: Path = Path("docs/results/methods-robot.json")
    filtered: Path = Path("docs/results/methods-filtered.json")
    document: Path = Path("docs/studies/methods.md")

    def paths(self) -> dict[str, Path]:
        """What was written, by what its marks on the page begin with."""
        return {
            "": self.results,
            "tuned-": self.tuned,
            "ppo-": self.ppo,
            "dqn-": self.dqn,
            "robot-": self.robot,
            "filtered-": self.filtered,
        }


def main(report: Report) -> None:
    """Read, and fill in."""
    fill(report.document, all_parts(report))


def all_parts(report: Report) -> dict[str, str]:
    """What stands between all marks of the page."""
    found = {prefix: json.loads(path.read_text(encoding="utf-8")) for prefix, path in report.paths().items()}
    parts = {"means": means({learner: of for prefix in LEARNED for learner, of in found[prefix]["over_tasks"].items()})}
    for prefix, results in found.items():
        parts |= parts_of(results, prefix)
    return {name: text for name, text in parts.items() if name not in LEFT_OUT}


def parts_of(results: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """What stands between the marks of the page, which begin with ``prefix``."""
    tables = [
        f"**{task}, {learner}**\n\n{table(summary)}"
        for task, of in results["summary"].items()
        for learner, summary in of.items()
    ]
    one = {task: next(iter(of.values())) for task, of in results["summary"].items()}
    return {
        f"{prefix}command": f"`{results['command']}`",
        f"{prefix}overview": overview(one, "of_primitives"),
        f"{prefix}random": overview(one, "of_random"),
        f"{prefix}race": "\n\n".join(tables),
    }


def means(by_learner: Mapping[str, Mapping[str, Any]]) -> str:
    """All tasks of a learner in one number for each phase; fewest steps of the first learner first.

    Marked as in `overview`.

    Args:
        by_learner: Of `summary.over_tasks`.
    """
    heads = [f"{LABELS[learner]}, {phase}" for learner in by_learner for phase in ("same task", "goal moved")]
    rows = [f"| | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    for entrant in dict.fromkeys(entrant for of in by_learner.values() for entrant in of):
        cells = [
            "1" if entrant == NONE else _mean(of.get(entrant), phase)
            for of in by_learner.values()
            for phase in ("same", "moved")
        ]
        rows.append(f"| {entrant} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _mean(of: Mapping[str, Any] | None, phase: str) -> str:
    """As "0.83 (0.71 to 0.94)"."""
    if of is None:
        return "–"
    return _marked(of["n_runs"], of[phase]["never"], number(of[phase]["of_primitives"]))


def overview(summaries: Mapping[str, Mapping[str, Any]], ratio: str) -> str:
    """All tasks of one learner: steps in the same task and with the goal moved, as a share of those of others.

    Marked * where some run never met the criterion, ≥ where a `MANY`-th did not.

    Args:
        summaries: By task, then by entrant.
        ratio: ``of_primitives`` or ``of_random``.
    """
    entrants = list(next(iter(summaries.values()), {}))
    rows = [f"| | {' | '.join(summaries)} |", "|---" * (len(summaries) + 1) + "|"]
    for entrant in entrants:
        cells = [_both(of[entrant], ratio) for of in summaries.values()]
        if any(cells):
            rows.append(f"| {entrant} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _both(of: Mapping[str, Any], ratio: str) -> str:
    """As "0.83, 0.20"; empty for those that are compared with."""
    phases = [of["same"], of["moved"]]
    if any(each.get(ratio) is None for each in phases):
        return ""
    return ", ".join(_marked(of["n_runs"], each["never"], f"{each[ratio]['mean']:.2f}") for each in phases)


def _marked(n_runs: int, never: int, ratio: str) -> str:
    """A ratio with the mark of what it leaves out."""
    if never >= MANY * n_runs:
        return f"≥{ratio}"
    return f"{ratio}{'*' if never else ''}"


def table(summary: Mapping[str, Any]) -> str:
    """A row for each entrant; the steps of primitives alone stand in the last one."""
    rows = [
        "| | options a run | subgoals at bottlenecks | runs that reach them | steps, same task | steps, goal moved "
        "| discovery, s |",
        "|---|---|---|---|---|---|---|",
    ]
    for entrant, of in summary.items():
        cells = [f"{of['found']['mean']:.1f}", number(of["near"]) or "–", number(of["reached"]) or "–"]
        for phase in ("same", "moved"):
            ratio, never = of[phase]["of_primitives"], of[phase]["never"]
            text = number(ratio) or f"{number(of[phase]['steps'], form='{:,.0f}')} steps"
            cells.append(text + (f", {never} never" if never else ""))
        cells.append(f"{of['discovery_seconds']['mean']:.2f}")
        rows.append(f"| {entrant} | {' | '.join(cells)} |")
    return "\n".join(rows)


if __name__ == "__main__":
    main(tyro.cli(Report))
