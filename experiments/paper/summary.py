"""The numbers of each figure, for results.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.common.curves import by_ten, curves_of, window
from experiments.common.gridworlds import NEAR
from experiments.common.intervals import ratio_interval
from experiments.common.seeds import Result
from experiments.paper.plots import CURVES, Groups
from sb3_options.envs import GridWorld
from sb3_options.experience.observations import FloatArray
from sb3_options.runs.intervals import mean_interval, share_interval

Numbers = dict[str, Any]


def numbers_of(figure: str, groups: Groups) -> Numbers:
    """Everything that is said of one figure."""
    special = {
        "figure1": _figure1,
        "figure2": _figure2,
        "figure3": _figure3,
        "figure4": _figure4,
        "negatives": _negatives,
    }
    numbers: Numbers = {}
    if figure in CURVES:
        numbers["steps_by_ten_trials"] = {
            f"{group}.{condition}": by_ten(curves_of(groups[group], condition))
            for group, condition, _ in CURVES[figure]
        }
    if figure in special:
        numbers |= special[figure](groups)
    if figure in RATIOS:
        numbers["ratios"] = {
            name: ratio(groups, ours, theirs, first, last)
            for name, (ours, theirs, first, last) in RATIOS[figure].items()
        }
    return numbers


RATIOS: dict[str, dict[str, tuple[str, str, int, int]]] = {
    "figure3": {
        "discovery_to_primitive_trials_30_39": ("learning.discovery", "learning.primitive", 30, 39),
        "discovery_to_primitive_trials_20_199": ("learning.discovery", "learning.primitive", 20, 199),
        "discovery_to_primitive_trials_250_299": ("learning.discovery", "learning.primitive", 250, 299),
    },
    "figure4": {
        f"{ours}_to_{theirs.split('.')[1]}_trials_20_199": (f"controls.{ours}", theirs, 20, 199)
        for ours in ("replay_whole", "replay_partial", "replay_whole_once", "replay_partial_once")
        for theirs in ("learning.primitive", "learning.discovery")
    },
    "figure5": {"options_to_primitive_trials_0_49": ("transfer.options", "transfer.primitive", 0, 49)},
    "figure6": {
        "whole_to_primitive_trials_0_49": ("reuse.whole", "transfer.primitive", 0, 49),
        "partial_to_primitive_trials_0_49": ("reuse.partial", "transfer.primitive", 0, 49),
        "whole_to_options_trials_0_49": ("reuse.whole", "transfer.options", 0, 49),
        "partial_to_options_trials_0_49": ("reuse.partial", "transfer.options", 0, 49),
    },
    "controls": {
        "random_to_primitive_trials_30_39": ("controls.random", "learning.primitive", 30, 39),
        "random_to_primitive_trials_20_199": ("controls.random", "learning.primitive", 20, 199),
        "handmade_to_discovery_trials_30_39": ("controls.handmade", "learning.discovery", 30, 39),
        "handmade_to_discovery_trials_20_199": ("controls.handmade", "learning.discovery", 20, 199),
        "handmade_to_primitive_trials_20_199": ("controls.handmade", "learning.primitive", 20, 199),
    },
}
"""By figure and name: whose mean steps, to whose, from which trial to which (counted from 0, both included)."""


def ratio(groups: Groups, ours: str, theirs: str, first: int, last: int) -> Numbers:
    """Ratio of mean steps in a window of trials, with its interval over runs."""

    def steps(name: str) -> FloatArray:
        group, condition = name.split(".")
        return window(curves_of(groups[group], condition), first, last)

    return ratio_interval(steps(ours), steps(theirs))._asdict()


def _figure1(groups: Groups) -> Numbers:
    world = GridWorld()
    (door_x, door_y), open_cells = world.doorways[0], ~world.walls
    open_cells[world.goal[1], world.goal[0]] = False
    numbers: Numbers = {}
    for kind in ("every", "first"):
        counts = np.array([r["visits"][kind] for r in groups["learning"]], dtype=np.float64)
        doorway, others = counts[:, door_y, door_x], counts[:, open_cells]
        numbers[kind] = {
            "doorway_to_mean": ratio_interval(doorway, others.mean(axis=1))._asdict(),
            "share_of_cells_below_doorway": mean_interval((others < doorway[:, None]).mean(axis=1))._asdict(),
        }
    return numbers


def _figure2(groups: Groups) -> Numbers:
    runs = groups["learning"]
    trials = [r["option"]["trial"] for r in runs if r["option"]["trial"] is not None]
    return {
        "diverse_density": _near([r["option"] for r in runs]),
        "first_visit_baseline": _near([r["baselines"]["first"] for r in runs]),
        "every_visit_baseline": _near([r["baselines"]["every"] for r in runs]),
        "option_trial": {
            "median": float(np.median(trials)) if trials else None,
            "earliest": min(trials, default=None),
            "latest": max(trials, default=None),
        },
        "runs_with_density_map": sum(r["log_density"] is not None for r in runs),
    }


def _near(found: list[Result]) -> Numbers:
    """How many of the subgoals lie at the doorway."""
    near = sum(f["distance"] is not None and f["distance"] <= NEAR for f in found)
    trials = [f["trial"] for f in found if f["trial"] is not None]
    return {
        "n_runs": len(found),
        "n_found": len(trials),
        "n_near_doorway": near,
        "share_near_doorway": share_interval(near, len(found))._asdict(),
        "median_trial": float(np.median(trials)) if trials else None,
    }


def _figure3(groups: Groups) -> Numbers:
    """Difference of the two means in standard deviations over runs, those of the two pooled."""
    primitive, discovery = (
        window(curves_of(groups["learning"], condition), 30, 39) for condition in ("primitive", "discovery")
    )
    deviation = float(np.sqrt((primitive.var() + discovery.var()) / 2))
    difference = float(primitive.mean() - discovery.mean())
    return {"difference_in_sd_trials_30_39": difference / deviation if deviation > 0 else None}


def _figure4(groups: Groups) -> Numbers:
    names = groups["controls"][0]["replayed"]
    return {
        "backups": {
            name: mean_interval(np.array([r["replayed"][name] for r in groups["controls"]], dtype=np.float64))._asdict()
            for name in names
        }
    }


def _negatives(groups: Groups) -> Numbers:
    limited, learning = groups["negatives"], groups["learning"]
    numbers: Numbers = {
        "negative_bags_of_25": mean_interval(np.array([r["n_negative"] for r in limited], dtype=np.float64))._asdict(),
        "no_negatives": _near([r["option"] for r in learning]),
    }
    for strength in ("strict", "soft"):
        numbers[f"step_limit_{strength}"] = _near([r[strength] for r in limited])
        numbers[f"noisy_{strength}"] = _near([r["noisy"][strength] for r in learning])
    return numbers | {"without_loops": _near([r["without_loops"] for r in limited])}
