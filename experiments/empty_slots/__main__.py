"""Do empty slots harm? Stock algorithms against the same with four slots that stay empty, on MiniGrid.

``python -m experiments.empty_slots --runs 20 --out FOLDER`` trains PPO, MaskablePPO and DQN, and writes
``results.json`` and ``empty_slots.png``. Interrupted, it goes on where it was. Needs the extra ``minigrid``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import tyro
from rich.table import Table

from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, show, write
from experiments.empty_slots.conditions import ARMS, LAST_EPISODES, N_SLOTS, N_TIMESTEPS, TASKS, Arm, run
from experiments.empty_slots.plots import draw
from experiments.empty_slots.summary import Summary, summarise


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Train with and without empty slots for many seeds, and compare the returns.

    Attributes:
        algorithms: Which.
        arms: What is compared with ``stock``.
    """

    runs: int = 20
    algorithms: tuple[str, ...] = tuple(TASKS)
    arms: tuple[Arm, ...] = ARMS[1:]


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    parts = [
        Part(f"{algorithm}, {arm}", partial(run, algorithm, arm), study.out / algorithm / arm.replace(" ", "_"))
        for arm in (ARMS[0], *study.arms)
        for algorithm in study.algorithms
    ]
    settings = {"tasks": TASKS, "n_timesteps": N_TIMESTEPS, "n_slots": N_SLOTS}
    results = run_parts(parts, study.seeds(), settings=settings, on=study, description="Training")
    summary = summarise(results)
    command = f"python -m experiments.empty_slots --runs {study.runs} --first-seed {study.first_seed} "
    command += f"--algorithms {' '.join(study.algorithms)} --arms {' '.join(study.arms)}"
    content = {"command": command, **settings, "summary": summary, "runs": results}
    write(study.out, content, {"empty_slots": draw(results)}, dpi=110)
    show(_table(summary), f"Results: {study.out / 'results.json'}, {study.out / 'empty_slots.png'}")


def _table(summary: Summary) -> Table:
    table = Table("", f"return, last {LAST_EPISODES} episodes", "minus stock", "p (same distribution)")
    for name, row in summary.items():
        mean, difference = row["final_return"], row.get("difference")
        cells = [f"{mean['mean']:.3f} ({mean['low']:.3f} to {mean['high']:.3f})", "", ""]
        if difference is not None:
            cells[1] = f"{difference['mean']:+.3f} ({difference['low']:+.3f} to {difference['high']:+.3f})"
            cells[2] = f"{row['p_same']:.2f}"
        table.add_row(name, *cells)
    return table


if __name__ == "__main__":
    main(tyro.cli(Study))
