"""How much oftener successes visit a concept than failures do: in all their time, and in equal times.

``python -m experiments.minigrid.keys --runs 3 --out FOLDER`` trains in ``DoorKey-5x5`` and compares the trajectories
that discovery has kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from rich.table import Table

from experiments.common.documents import number
from experiments.common.seeds import Result, run_seeds
from experiments.common.study import Flags, show, write
from experiments.minigrid import settings
from experiments.minigrid.agents import model_of, venv_of
from experiments.minigrid.conditions import SEEDS_APART
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.groups import FeatureGroup
from sb3_options.discovery.contrast import Contrast
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.envs.minigrid import FEATURES, concept_groups
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.runs.intervals import mean_interval

TASK = "MiniGrid-DoorKey-5x5-v0"

Where = tuple[float, float] | None
"""Cells ahead and to the right; None: anywhere in view."""

CONCEPTS: dict[str, dict[str, Where]] = {
    "key straight ahead": {"key": (1, 0)},
    "key in hand": {"key": (0, 0)},
    "locked door straight ahead": {"locked_door": (1, 0)},
    "locked door straight ahead, key in hand": {"key": (0, 0), "locked_door": (1, 0)},
    "open door straight ahead": {"open_door": (1, 0)},
    "goal straight ahead": {"goal": (1, 0)},
    "key in view": {"key": None},
    "locked door in view": {"locked_door": None},
    "open door in view": {"open_door": None},
    "goal in view": {"goal": None},
}
"""By name, where which things are."""


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Compare successes and failures.

    Attributes:
        frames: Primitive steps of training.
    """

    runs: int = 3
    frames: int = 40_000


def point_of(concept: dict[str, Where]) -> FloatArray:
    """All features (1, d) where these things are there, and no others."""
    point = np.zeros((1, len(FEATURES)))
    for kind, where in concept.items():
        first = FEATURES.index(f"{kind}_visible")
        point[0, first : first + 3] = 1, *(where or (0, 0))
    return point


def contrast_of(concept: dict[str, Where], lived: Sequence[LabelledTrajectory], *, equal_time: bool) -> float:
    """The contrast of a concept in the group of features that it is about; -1 if no trajectory visited it."""
    name = " and ".join(concept)
    (group,) = (FeatureGroup(**fields) for fields in concept_groups() if fields["name"] == name)
    if None in concept.values():
        group = FeatureGroup(name, [FEATURES.index(f"{name}_visible")], present=[[FEATURES.index(f"{name}_visible")]])
    contrast = Contrast(group, DiscoverySettings().subgoal_radius, equal_time=equal_time)
    contrast.update(lived)
    try:
        return float(contrast.of(point_of(concept))[0])
    except KeyError:
        return -1.0


def compare(seed: int, frames: int) -> Result:
    """Train without installing options, and compare what was kept.

    Returns:
        ``successes``, ``failures``: how many trajectories; ``equal_time`` and ``all_time``: contrasts by concept.
    """
    venv = venv_of(TASK, seed * SEEDS_APART, n_envs=settings.N_ENVS, slots=1)
    model = model_of("discovered", venv, seed * SEEDS_APART)
    never = {**settings.DISCOVERY, "min_positive": settings.DISCOVERY["capacity"] + 1}
    callback = SubgoalDiscoveryCallback(never, seed=seed)
    model.learn(frames, callback=callback)
    assert callback.discovery is not None  # made when training started
    lived = list(callback.discovery.database)
    result: Result = {"seed": seed, "successes": sum(t.success for t in lived)}
    result["failures"] = len(lived) - result["successes"]
    for name, equal in (("all_time", False), ("equal_time", True)):
        result[name] = {what: contrast_of(concept, lived, equal_time=equal) for what, concept in CONCEPTS.items()}
    venv.close()
    return result


def main(study: Study) -> None:
    """Run the comparison, and write and print what it found."""
    used: dict[str, Any] = {"task": TASK, "frames": study.frames, "ppo": settings.PPO, "n_envs": settings.N_ENVS}
    results = run_seeds(lambda seed: compare(seed, study.frames), study.seeds(), study.out, settings=used, on=study)
    table = Table("concept", "contrast, all time", "contrast, equal times")
    summary: dict[str, Any] = {}
    for what in CONCEPTS:
        summary[what] = {
            how: mean_interval(np.array([r[how][what] for r in results]))._asdict()
            for how in ("all_time", "equal_time")
        }
        table.add_row(what, *(number(interval) for interval in summary[what].values()))
    command = f"python -m experiments.minigrid.keys --runs {study.runs} --first-seed {study.first_seed}"
    write(study.out, {"command": command, **used, "summary": summary, "runs": results}, {})
    show(table, f"Results: {study.out / 'results.json'}")


if __name__ == "__main__":
    main(tyro.cli(Study))
