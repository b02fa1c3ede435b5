"""``python -m experiments.pioneer.report STUDY BENCHMARK TWIN docs/studies/pioneer.md``: fills in the numbers.

No number is copied by hand.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.common.documents import fill, number, settings_table
from experiments.pioneer.settings import TASKS
from experiments.pioneer.twin import table as twin_table


@dataclass(frozen=True)
class Report:
    """Put the numbers of the study and of the benchmark into their document.

    Attributes:
        results: What the study wrote.
        benchmark: What `benchmarks.pioneer` wrote.
        twin: What `experiments.pioneer.twin` wrote.
        document: Markdown with the markers.
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULTS")]
    benchmark: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="BENCHMARK")]
    twin: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TWIN")]
    document: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DOCUMENT")]


def main(report: Report) -> None:
    """Read, and fill in."""
    results = json.loads(report.results.read_text(encoding="utf-8"))
    twin = json.loads(report.twin.read_text(encoding="utf-8"))
    figures = results["figures"]
    if not {"figure8", "learning", "transfer", "dqn"} <= set(figures):
        raise ValueError(f"{report.results} holds {', '.join(figures)} only: run `all` into that folder first.")
    parts = {
        "run": f"`{results['command']}`",
        "subgoals": subgoals(figures["figure8"]),
        "evaluation": evaluation_table({"MacroQ": figures["learning"], "DQN": figures["dqn"]}),
        "dqn": ratios_table({f"DQN, {figures['dqn']['n_runs']} runs": figures["dqn"]["ratios"]}),
        "ratios": ratios_table(
            {f"main task, {results['n_runs']} runs": figures["learning"]["ratios"]}
            | {
                f"{task.replace('_', ' ')}, {figures['transfer']['n_runs']} runs": figures["transfer"][task]["ratios"]
                for task in TASKS
            }
        ),
        "cost": cost_table(json.loads(report.benchmark.read_text(encoding="utf-8"))),
        "settings": settings_table(results["settings"]),
        "twin run": f"`{twin['command']}`",
        "twin": twin_table(twin),
    }
    fill(report.document, parts)


def subgoals(numbers: dict[str, Any]) -> str:
    """Where the subgoals fell, in a sentence."""
    found = [s for s in numbers["subgoals"] if s["width"] is not None]
    displacement = [abs(math.degrees(s["displacement"])) for s in found]
    width = [math.degrees(s["width"]) for s in found]
    share = numbers["share_near_and_ahead"]
    return (
        f"{numbers['n_near_and_ahead']} of {numbers['n_runs']} runs made their option for the ball dead ahead and near "
        f"(95 % interval of the share {share['low']:.2f} to {share['high']:.2f}), at trial {numbers['median_trial']:g} "
        f"in the median. |displacement| is {max(displacement, default=math.nan):.1f}° at most, width "
        f"{min(width, default=math.nan):.1f}° at least."
    )


def evaluation_table(learners: dict[str, dict[str, Any]]) -> str:
    """Success, length and touches of the trials after learning."""
    rows = ["| | success rate | worst run | primitive steps | wall touches a trial |", "|---|---|---|---|---|"]
    for learner, numbers in learners.items():
        for name, words in (("primitive", "primitives only"), ("discovery", "with subgoal discovery")):
            e = numbers[name]["evaluation"]
            rate, steps, touches = (number(e[key]) for key in ("success_rate", "steps", "touches"))
            rows.append(f"| {learner}, {words} | {rate} | {e['success_rate']['worst_run']:.2f} | {steps} | {touches} |")
    return "\n".join(rows)


def ratios_table(columns: dict[str, dict[str, Any]]) -> str:
    """Every ratio of primitive steps, with the option to without."""
    names = list(dict.fromkeys(name for ratios in columns.values() for name in ratios))
    rows = [f"| trials | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for name in names:
        cells = [number(ratios[name]) if name in ratios else "–" for ratios in columns.values()]
        rows.append(f"| {name.removeprefix('steps_trials_').replace('_', '–')} | {' | '.join(cells)} |")
    return "\n".join(rows)


def cost_table(benchmark: dict[str, Any]) -> str:
    """What a step takes, beside the peer."""
    peer, share = benchmark["peer"], benchmark["pybullet_share_of_step"]
    rows = {
        "primitive actions per second": "primitive_actions_per_second",
        "physics steps in an action": "physics_steps_per_action",
        f"share of a step inside PyBullet's C functions (bar: {share['bar']})": "pybullet_share_of_step",
        f"the same of panda-gym's {peer}": "panda_gym_pybullet_share_of_step",
        "µs per physics step": "pioneer_microseconds_per_physics_step",
        "the same of panda-gym": "panda_gym_microseconds_per_physics_step",
        "ours to panda-gym's": "pioneer_of_panda_gym_per_physics_step",
    }
    lines = [f"| {words} | {number(benchmark[key])} |" for words, key in rows.items()]
    return "\n".join(["| | mean (95 % interval) |", "|---|---|", *lines])


if __name__ == "__main__":
    main(tyro.cli(Report))
