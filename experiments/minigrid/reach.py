"""How often discovered options reach their subgoals: begun in all of I, and where the saved steps promise it.

``python -m experiments.minigrid.reach --family KeyCorridor --runs 4 --out FOLDER`` trains in a family's first task.
Each subgoal that is discovered meanwhile gets two options, one with ``min_reach=0`` and one with the default, which are
then run in the first task and in the last one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from rich.table import Table

from experiments.common.seeds import Result, run_seeds
from experiments.common.study import Flags, show, write
from experiments.minigrid import settings
from experiments.minigrid.agents import model_of, venv_of
from experiments.minigrid.conditions import FRESH, SEEDS_APART
from experiments.minigrid.settings import FAMILIES
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.regions import Region
from sb3_options.options.creation import learn_option
from sb3_options.options.option import SubgoalOption
from sb3_options.options.settings import OptionLearningSettings

OPTION_SHARE = 0.5
"""How often an option is chosen where it may begin; else a primitive action, uniformly."""

MOST_RUNS = 100
"""Of an option in a task."""

MOST_CHOICES = 600
"""Of each environment, whether the option has run so often or not."""

N_ENVS = 4

LEASTS = {"all of I": 0.0, "min_reach": OptionLearningSettings().min_reach}


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Run options in the first and the last task of a family.

    Attributes:
        family: Which.
        frames: Primitive steps of training in the first task.
    """

    runs: int = 4
    family: str = "KeyCorridor"
    frames: int = 60_000


class Learns(SubgoalDiscoveryCallback):
    """Learns the options of each subgoal, and installs none."""

    learned: list[dict[str, Any]]

    def _make_option(self, subgoal: Region) -> None:
        assert subgoal.group is not None  # MiniGrid has groups
        options = {
            name: learn_option(
                subgoal,
                self._search.database,
                self._options.n_primitive,
                OptionLearningSettings(min_reach=least),
                torch.Generator().manual_seed(self.seed),
            )
            for name, least in LEASTS.items()
        }
        point = ", ".join(f"{value:g}" for value in subgoal.points[0])
        self.learned.append({"where": f"{subgoal.group.name} at {point}", "options": options})


def runs_of(option: SubgoalOption, task: str, seed: int) -> dict[str, float]:
    """What the runs of an option came to, among uniformly random actions.

    Returns:
        ``runs``, how many; ``reached``, how many of them the subgoal; ``steps``, of all of them.
    """
    venv = venv_of(task, seed, n_envs=N_ENVS, slots=1)
    venv.env_method("set_option", 0, option)
    n_primitive = venv.get_attr("n_primitive", [0])[0]
    rng, ends, steps = np.random.default_rng(seed), Counter[str](), 0
    venv.reset()
    for _ in range(MOST_CHOICES):
        may = np.stack(venv.env_method("action_masks"))[:, n_primitive]
        begins = may & (rng.random(N_ENVS) < OPTION_SHARE)
        *_, infos = venv.step(np.where(begins, n_primitive, rng.integers(n_primitive, size=N_ENVS)))
        for info in np.array(infos)[begins]:
            ends[info["option"]["termination"]] += 1
            steps += info["option"]["duration"]
        if ends.total() >= MOST_RUNS:
            break
    venv.close()
    return {"runs": ends.total(), "reached": ends["subgoal"], "steps": steps}


def compare(family: str, frames: int, seed: int) -> Result:
    """Learn the options, and run them.

    Returns:
        ``options``: of each subgoal ``where`` it is, and by how I was made the ``points`` in I and `runs_of` the option
        in the ``first`` task and in the ``last``.
    """
    first, last = FAMILIES[family][0].env_id, FAMILIES[family][-1].env_id
    venv = venv_of(first, seed * SEEDS_APART, slots=settings.max_options(family))
    callback = Learns(settings.DISCOVERY, seed=seed)
    callback.learned = []
    model_of("discovered", venv, seed * SEEDS_APART).learn(frames, callback=callback)
    venv.close()
    about = []
    for each in callback.learned:
        found: dict[str, Any] = {"where": each["where"]}
        for name, option in each["options"].items():
            if option is None:
                found[name] = {"points": 0}
                continue
            at = {stage: runs_of(option, task, seed + FRESH) for stage, task in (("first", first), ("last", last))}
            found[name] = {"points": len(option.initiation_set.points), **at}
        about.append(found)
    return {"seed": seed, "options": about}


def share(results: list[Result], how: str, stage: str) -> tuple[float, int]:
    """The share of all runs that reached their subgoal, and how many runs."""
    runs = [option[how][stage] for result in results for option in result["options"] if stage in option[how]]
    n = sum(run["runs"] for run in runs)
    return sum(run["reached"] for run in runs) / max(n, 1), int(n)


def main(study: Study) -> None:
    """Run the comparison, and write and print what it found."""
    used: dict[str, Any] = {
        "family": study.family, "frames": study.frames, "ppo": settings.PPO, "n_envs": settings.N_ENVS,
        "discovery": settings.DISCOVERY, "leasts": LEASTS,
    }  # fmt: skip
    results = run_seeds(
        lambda seed: compare(study.family, study.frames, seed),
        study.seeds(), study.out / study.family, settings=used, on=study,
    )  # fmt: skip
    table, summary = Table("options begin in", "subgoals", "reached, first task", "last task"), {}
    for how in LEASTS:
        made = [option[how]["points"] for result in results for option in result["options"] if option[how]["points"]]
        shares = {stage: share(results, how, stage) for stage in ("first", "last")}
        summary[how] = {"options": len(made), "points": float(np.mean(made)) if made else 0.0, **shares}
        table.add_row(how, str(len(made)), *(f"{reached:.2f} of {n}" for reached, n in shares.values()))
    command = f"python -m experiments.minigrid.reach --family {study.family} --frames {study.frames} "
    command += f"--runs {study.runs} --first-seed {study.first_seed}"
    write(study.out, {"command": command, **used, "summary": summary, "runs": results}, {})
    show(table, f"Results: {study.out / 'results.json'}")


if __name__ == "__main__":
    main(tyro.cli(Study))
