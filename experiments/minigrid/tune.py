"""``python -m experiments.minigrid.tune --arms "stock, curriculum" "discovered, RND at first" --out FOLDER``.

Chooses PPO's settings, and the weight of a bonus, for each agent: the same search space, the same number of trials and
the same seeds. The first trial is the study's settings. Interrupted, it goes on where it was. What was best goes into
``tuned.json``, which ``experiments.minigrid --tuned`` reads.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from rich.console import Console
from rich.json import JSON

from experiments.common.machines import Machines
from experiments.common.seeds import Part, run_parts, write_json
from experiments.common.study import show
from experiments.deep.search import Search, best_of, choices, opened, work
from experiments.minigrid import settings
from experiments.minigrid.__main__ import folder_of
from experiments.minigrid.conditions import Protocol, run, stages_of
from experiments.minigrid.settings import Arm, Tuned
from experiments.minigrid.summary import frames_to

SPACE: dict[str, BaseDistribution] = {
    "learning_rate": FloatDistribution(1e-4, 3e-3, log=True),
    "n_steps": choices((32, 64, 128, 256)),
    "batch_size": choices((128, 256, 512)),
    "n_epochs": choices((2, 4, 8)),
    "ent_coef": FloatDistribution(1e-3, 5e-2, log=True),
    "gae_lambda": choices((0.9, 0.95, 0.98)),
    "clip_range": choices((0.1, 0.2, 0.3)),
}
WEIGHT = FloatDistribution(0.01, 1.0, log=True)

LEARNED, REACHED = 0.9, 0.8
"""Success at which a stage before the last ends, and the last one."""


@dataclass(frozen=True, kw_only=True)
class Tuning(Machines):
    """Choose PPO's settings for some agents.

    Attributes:
        out: Folder for tuned.json and the trials.
        family: Of the tasks.
        arms: Which agents.
        trials: How many settings are tried for each.
        first_seed: Each trial is run with the seeds from here on.
        seeds: How many.
    """

    out: Path
    family: str = "MultiRoom-4"
    arms: tuple[Arm, ...] = ("stock, curriculum", "stock, E3B", "stock, RND at first", "discovered, RND at first")
    trials: int = 20
    first_seed: int = 100
    seeds: int = 3


def main(tuning: Tuning) -> None:
    """Try, and write and print what was best for each agent."""
    told = f"--trials {tuning.trials} --first-seed {tuning.first_seed} --seeds {tuning.seeds}"
    arms = " ".join(map(repr, tuning.arms))
    content: dict[str, Any] = {
        "family": tuning.family,
        "command": f"python -m experiments.minigrid.tune --family {tuning.family} {told} --arms {arms}",
        "tuned": {arm: best_for(tuning, arm) for arm in tuning.arms},
    }
    write_json(tuning.out / "tuned.json", content)
    show(JSON.from_data(content))


def best_for(tuning: Tuning, arm: Arm) -> dict[str, Any]:
    """The best settings of one agent, their score, and that of the study's settings: mean frames, geometric."""
    folder = tuning.out / folder_of(arm)
    space = SPACE | ({"weight": WEIGHT} if arm in settings.BONUS else {})
    search = Search(
        folder,
        space,
        partial(_scores, tuning, arm),
        tuning.trials,
        asked={"seeds": [tuning.first_seed, tuning.seeds], "family": tuning.family},
        shown=lambda score: f"{math.exp(score):,.0f} frames",
    )
    study = opened(search)
    defaults = {
        name: json.dumps(value) if isinstance(space[name], CategoricalDistribution) else value
        for name, value in settings.tuned_of(arm).items()
        if name in space
    }
    if not study.trials:
        study.enqueue_trial(defaults)
    work(study, search, Console(highlight=False, soft_wrap=True))
    _, best = best_of(study, search)
    of_defaults = next(trial.value for trial in study.trials if trial.params == defaults and trial.value is not None)
    frames = {"frames": math.exp(study.best_value), "frames_of_defaults": math.exp(of_defaults)}
    return {"settings": best, "trial": study.best_trial.number, **frames}


def _scores(tuning: Tuning, arm: Arm, place: str, proposed: Tuned) -> Iterator[float]:
    """Log of the frames to `REACHED`, seed after seed; a run that never gets there counts with all its frames."""
    protocol = Protocol(LEARNED, REACHED, ())
    function = partial(run, tuning.family, arm, protocol, tuned=proposed)
    part = Part(arm, function, tuning.out / folder_of(arm) / place, proposed)
    seeds = range(tuning.first_seed, tuning.first_seed + tuning.seeds)
    longest = sum(stage.frames for stage in stages_of(tuning.family, arm))
    for result in run_parts([part], seeds, settings={}, on=tuning, description=f"{arm}, {place}")[arm]:
        yield math.log(frames_to(result, tuning.family, arm, REACHED) or longest)


if __name__ == "__main__":
    main(tyro.cli(Tuning))
