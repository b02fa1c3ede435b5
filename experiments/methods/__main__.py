"""``python -m experiments.methods --runs 20 --out FOLDER``: the race of methods of discovery.

Every method finds subgoals in the same tasks with the same seeds, learners and budget, and options are learned for
them in one way. Then the goal moves, and the options are taken along. Writes ``results.json`` and ``race.png``.
Interrupted, it goes on where it was: every finished run is kept below ``FOLDER``, also for a call with other methods,
tasks or learners.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import tyro
from rich.table import Table

from experiments.common.documents import number
from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, show, write
from experiments.methods.conditions import EVALUATE_EVERY, LENGTHS, MACROQ, SETTINGS, Entry, length_of, run
from experiments.methods.entrants import ENTRANTS, POSSIBLE, all_settings_of, chosen_settings
from experiments.methods.plots import draw
from experiments.methods.summary import over_tasks, summarise
from experiments.methods.tasks import TASKS

RACE = "race"
"""Name of the picture."""


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Which method's options help most?

    Attributes:
        methods: Who races; by default all, with ``hand-made`` places and ``none``, primitives alone. Besides there is
            ``random-filtered``: states drawn from those that diverse density searches.
        tasks: Where; by default everywhere. The robot needs the extra ``pioneer``.
        learners: Who learns: macroq (Macro Q-learning), dqn (OptionDQN), ppo (MaskablePPO).
        settings: Of the methods: their defaults, or what ``experiments.methods.tune`` chose.
        n_timesteps: Primitive steps of each training, at most; by default as the learner needs.
    """

    runs: int = 20
    methods: tuple[str, ...] = ENTRANTS
    tasks: tuple[str, ...] = TASKS
    learners: tuple[str, ...] = tuple(LENGTHS)
    settings: Literal["defaults", "tuned"] = "defaults"
    n_timesteps: int | None = None

    def __post_init__(self) -> None:
        """Refuse what there is not, by name."""
        super().__post_init__()
        for name, possible in (("methods", POSSIBLE), ("tasks", TASKS), ("learners", tuple(LENGTHS))):
            for value in getattr(self, name):
                if value not in possible:
                    raise SystemExit(f"--{name}: there is no {value!r}, choose from {', '.join(possible)}.")

    def command(self) -> str:
        """What was called."""
        words = ["--runs", str(self.runs), "--first-seed", str(self.first_seed), "--settings", self.settings]
        for name, usual in (("methods", ENTRANTS), ("tasks", TASKS), ("learners", tuple(LENGTHS))):
            chosen = getattr(self, name)
            words += [] if chosen == usual else [f"--{name}", *chosen]
        if self.n_timesteps is not None:
            words += ["--n-timesteps", str(self.n_timesteps)]
        return f"python -m experiments.methods {shlex.join(words)}"


def main(study: Study) -> None:
    """Run the race, and write and print what it found."""
    chosen = chosen_settings(study.methods, study.settings)
    cells = [(task, learner) for learner in study.learners for task in study.tasks]
    lengths = {cell: study.n_timesteps or length_of(*cell) for cell in cells}
    parts = [
        Part(
            f"{task}, {learner}, {entrant}",
            partial(run, Entry(task, learner, entrant, chosen[entrant], lengths[task, learner])),
            study.out / learner / task.replace(" ", "-") / f"{entrant}-{study.settings}",
            {
                "method": all_settings_of(entrant, chosen[entrant]),
                "n_timesteps": lengths[task, learner],
                **_learner(learner),
            },
        )
        for task, learner in cells
        for entrant in study.methods
    ]
    results = run_parts(parts, study.seeds(), settings={}, on=study, description="Racing")
    summaries: dict[str, dict[str, Any]] = {task: {} for task in study.tasks}
    for task, learner in cells:
        of = {entrant: results[f"{task}, {learner}, {entrant}"] for entrant in study.methods}
        summaries[task][learner] = summarise(of, lengths[task, learner])
    named_lengths = {f"{task}, {learner}": n for (task, learner), n in lengths.items()}
    means = over_tasks(results, named_lengths)
    content = {
        "command": study.command(),
        "settings": {
            "methods": {entrant: all_settings_of(entrant, of) for entrant, of in chosen.items()},
            "lengths": named_lengths,
        },
        "over_tasks": means,
        "summary": summaries,
        "runs": results,
    }
    write(study.out, content, {RACE: draw(summaries, means)}, dpi=110)
    show(*(table(task, learner, summaries[task][learner]) for task, learner in cells), f"Results: {study.out}")


def _learner(learner: str) -> dict[str, Any]:
    """What the results of a learner depend on."""
    if learner == "macroq":
        return dict(MACROQ)
    return {**SETTINGS.of(learner, "options"), "evaluate_every": EVALUATE_EVERY[learner]}


def table(task: str, learner: str, summary: dict[str, dict[str, Any]]) -> Table:
    """A row for each entrant."""
    columns = ("near", "reached", "same task", "never", "goal moved", "never", "discovery, s", "of training")
    rows = Table(f"{task}, {learner}", *columns)
    for entrant, of in summary.items():
        same, moved = of["same"], of["moved"]
        rows.add_row(
            entrant,
            number(of["near"]),
            number(of["reached"]),
            number(same["of_primitives"]) or number(same["steps"], form="{:,.0f}"),
            str(same["never"]),
            number(moved["of_primitives"]) or number(moved["steps"], form="{:,.0f}"),
            str(moved["never"]),
            number(of["discovery_seconds"]),
            number(of["discovery_share"], form="{:.3f}"),
        )
    return rows


if __name__ == "__main__":
    main(tyro.cli(Study))
