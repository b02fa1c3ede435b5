"""The numbers of the study, for results.json."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.common.seeds import Result
from experiments.minigrid.conditions import stages_of
from experiments.minigrid.settings import DISCOVERED, REACHED, Arm
from sb3_options.runs.intervals import mean_interval

Summary = dict[str, dict[str, Any]]

REACH = {"source": 0.8, "target": 0.7}
"""Least share of an option's runs that must reach its subgoal, where it was found and in the last task."""

JUDGED_RUNS = 20
"""Fewer runs of an option say little of it."""


def run_frames(run: Result, family: str, arm: Arm) -> list[int]:
    """Frames that a run took in each of its stages."""
    budgets = [stage.frames for stage in stages_of(family, arm)]
    return [noted.get("frames", budget) for noted, budget in zip(run["stages"], budgets, strict=True)]


def frames_to(run: Result, family: str, arm: Arm, success: float) -> int | None:
    """Frames of all stages until the training success of the last task is at least this, and stays so; None if never.

    The first rates of a task are those of few episodes, and of short ones: they do not count by themselves.
    """
    before = sum(run_frames(run, family, arm)[:-1])
    reached: int | None = None
    for frames, rate in run["stages"][-1]["curve"]:
        if rate < success:
            reached = None
        elif reached is None:
            reached = int(before + frames)
    return reached


def median_frames(frames: Sequence[int | None]) -> float | None:
    """The median over all seeds, in which those that never got there count as the slowest; None if it is never."""
    median = float(np.median([np.inf if each is None else each for each in frames]))
    return median if np.isfinite(median) else None


def summarise(family: str, results: Mapping[str, Sequence[Result]]) -> Summary:
    """What each agent came to.

    Args:
        family: Of the tasks.
        results: By agent.

    Returns:
        ``arms``: by agent the success in fresh episodes with its 95 % interval over seeds, the frames of all stages to
        each success of `REACHED` for every seed, and their medians, and the seconds of training, by the clock and of
        the processor; ``uniform``: success of a uniform choice; ``options``: by subgoal, how many seeds discovered it,
        and the share of its runs that reached it, by stage; ``reach``: of the options of each agent, as `reach` has it.
    """
    summary: Summary = {"arms": {}, "uniform": {}, "options": {}}
    for name, runs in results.items():
        judged = [how for how in ("sampled", "greedy") if how in runs[0]["success"]]
        arm: Arm = name  # type: ignore[assignment]  # the names of the parts are arms
        summary["arms"][name] = {
            "n_runs": len(runs),
            "success": {how: _mean([run["success"][how] for run in runs]) for how in judged},
            "frames_to": {str(least): [frames_to(run, family, arm, least) for run in runs] for least in REACHED},
            "median_frames_to": {
                str(least): median_frames([frames_to(run, family, arm, least) for run in runs]) for least in REACHED
            },
            "seconds": _mean([sum(stage["seconds"] for stage in run["stages"]) for run in runs]),
            "processor_seconds": _mean([sum(stage["processor_seconds"] for stage in run["stages"]) for run in runs]),
        }
        if "uniform" in runs[0]["success"]:
            summary["uniform"][name] = _mean([run["success"]["uniform"] for run in runs])
    runs = [run for arm in DISCOVERED for run in results.get(arm, ())]
    summary["options"], summary["reach"] = _options(runs), reach(runs)
    return summary


def reach(runs: Sequence[Result]) -> dict[str, dict[str, int]]:
    """How many options there are, each agent's on its own, and how many of them reach their subgoals too rarely.

    Args:
        runs: Of agents that discover.

    Returns:
        By stage, ``source``, where an option was found, and ``target``, the last one: ``options`` with `JUDGED_RUNS`
        runs there at least, and of these those ``below`` the share of `REACH`.
    """
    counts = {where: {"options": 0, "below": 0} for where in REACH}
    for run in runs:
        places = {option["where"]: option["stage"] for option in reversed(run["options"])}  # where it was found first
        for where, stage in places.items():
            for name, at in (("source", stage), ("target", -1)):
                ends = Counter(run["stages"][at]["option_runs"].get(f"reach {where}", {}))
                if ends.total() >= JUDGED_RUNS:
                    counts[name]["options"] += 1
                    counts[name]["below"] += ends["subgoal"] / ends.total() < REACH[name]
    return counts


def _options(runs: Sequence[Result]) -> dict[str, Any]:
    """By subgoal, how many seeds discovered it, and how many of its runs reached it in each stage."""
    found: Counter[str] = Counter()
    ends: dict[str, list[Counter[str]]] = {}
    for run in runs:
        for where in {option["where"] for option in run["options"]}:
            found[where] += 1
            counts = ends.setdefault(where, [Counter() for _ in run["stages"]])
            for stage, count in zip(run["stages"], counts, strict=True):
                count.update(stage["option_runs"].get(f"reach {where}", {}))
    return {
        where: {
            "n_runs": n,
            "reached": [count["subgoal"] / count.total() if count else None for count in ends[where]],
            "runs": [count.total() for count in ends[where]],
        }
        for where, n in found.most_common()
    }


def _mean(values: Sequence[float]) -> dict[str, Any]:
    return mean_interval(np.array(values, dtype=np.float64))._asdict()
