"""Training in a series of tasks, one after another, and going on with one that was cut off."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeGuard

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.atomic import atomic_write
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import yaml_file
from sb3_options.runs.closing import IN_A_ROW, Trained, learned_after
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.task_ends import KEPT, free_slots

SERIES, BEFORE = "series.yml", "before.yml"
"""Files in the run folder of a task: the configuration of its series, and what was done before the task."""

CELLS = 5
"""Of a row of the table."""


@dataclass(frozen=True)
class Series:
    """A series, when one of its tasks begins.

    Attributes:
        config: Of all tasks.
        before: Names of the run folders of the tasks before, in order.
        rows: What the table at the end says of each of them.
    """

    config: TrainConfig
    before: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()

    @property
    def is_last(self) -> bool:
        """Whether the task is the last one."""
        return len(self.before) + 1 == len(self.config.series)

    def save(self, folder: Path) -> None:
        """Leave in the run folder of the task what `read` needs."""
        configs.save(self.config, folder / SERIES)
        content = {"before": list(self.before), "rows": [list(row) for row in self.rows]}
        with atomic_write(folder / BEFORE) as temporary:
            temporary.write_text(yaml_file.dump(content), encoding="utf-8")


class Train(Protocol):
    """Trains in one task."""

    def __call__(self, config: TrainConfig, *, series: Series | None = None, resumed: Path | None = None) -> Trained:
        """Train with a configuration; ``resumed`` is the run folder to go on in."""


def read(run: Path, trusted: Mapping[str, str | None]) -> Series | None:
    """The series that the task of a run folder is in; None where it is in none.

    Args:
        run: Of the task.
        trusted: As `configs.load` takes it.

    Raises:
        ValueError: Its files hold something else, or the series has gone on with the next task.
    """
    if not (run / SERIES).is_file():
        return None
    config, content = configs.load(run / SERIES, trusted), yaml_file.read_mapping(run / BEFORE)
    before, rows = content.get("before"), content.get("rows")
    if not (
        _is_texts(before)
        and isinstance(rows, list)
        and all(_is_texts(row) and len(row) == CELLS for row in rows)
        and len(before) == len(rows) < len(config.series)
        and all(Path(name).name == name for name in before)
    ):
        raise ValueError(f"{run / BEFORE} does not say what was done before this task of {run / SERIES}.")
    later = [
        other
        for other in sorted(run.resolve().parent.glob(f"*/{BEFORE}"))
        if run.resolve().name in _names(other) and any(CheckpointFolder(other.parent / runs.CHECKPOINTS))
    ]
    if later:
        last = max(later, key=lambda other: len(_names(other)))
        raise ValueError(f"The series has gone on after {run}: resume the last one, {run.parent / last.parent.name}.")
    return Series(config, tuple(before), tuple(map(tuple, rows)))


def _is_texts(value: Any) -> TypeGuard[list[str]]:
    return isinstance(value, list) and all(type(each) is str for each in value)


def _names(file: Path) -> list[str]:
    """The tasks before one of any series; none where the file says nothing of the kind."""
    try:
        names = yaml_file.read_mapping(file).get("before")
    except (OSError, ValueError):
        return []
    return names if isinstance(names, list) else []


def train_in_turn(config: TrainConfig, train: Train, console: Console) -> list[Path]:
    """Train in one task after another; each begins with the options of the one before, and with a network of its own.

    A task ends when it is learned (`StopWhenLearned`), the last one with the budget, which all tasks share. Options
    that its successes do not need leave their slots (`free_slots`).

    Args:
        config: With a ``series``.
        train: Trains in one.
        console: Where the table goes.

    Returns:
        The run folder of each task that was begun.

    Raises:
        As ``train``; and ValueError: A task cannot be made.
    """
    if config.compare:
        raise ValueError("--compare is for one task: leave it out, or train the last task of the series alone.")
    runs.check_env_id(config.env)
    for number, task in enumerate(_tasks(config), start=1):  # a mistake in the last one is no surprise after hours
        try:
            runs.make_env(task, 1, config.seed).close()
        except Exception as error:
            error.add_note(f"This is task {number} of the series.")
            raise
    return _reported(_InTurn(Series(config), train, console, []), None)


def go_on(series: Series, config: TrainConfig, run: Path, train: Train, console: Console) -> list[Path]:
    """Go on with a series in the task that was under way; what the tasks before have left stays as it is.

    Args:
        series: As `read` gave it.
        config: Of the task.
        run: Its run folder.
        train: Trains in one.
        console: Where the table goes.

    Returns:
        As `train_in_turn`.
    """
    return _reported(_InTurn(series, train, console, [run.parent / name for name in series.before]), (config, run))


def _tasks(config: TrainConfig) -> list[TrainConfig]:
    return [dataclasses.replace(config, series=(), env_kwargs={**config.env_kwargs, **task}) for task in config.series]


@dataclass
class _InTurn:
    """A series under way.

    Attributes:
        series: Before the task that comes next.
        train: Trains in one.
        console: For what is printed.
        folders: Of the tasks that were begun.
    """

    series: Series
    train: Train
    console: Console
    folders: list[Path]

    def run(self, resumed: tuple[TrainConfig, Path] | None) -> None:
        """Train until the last task or the budget is at its end; the first training may be one that goes on."""
        whole = self.series.config
        left, options = whole.n_timesteps, whole.options
        for number, task in list(enumerate(_tasks(whole), start=1))[len(self.folders) :]:
            name = json.dumps(whole.series[number - 1])
            self.console.print(f"\n[bold]Task {number} of {len(whole.series)}[/]: {escape(name)}")
            if resumed is None:
                done = self.train(dataclasses.replace(task, n_timesteps=left, options=options), series=self.series)
            else:
                left = resumed[0].n_timesteps
                done = self.train(resumed[0], series=self.series, resumed=resumed[1])
                resumed = None
            last = self.series.is_last
            bank = done.discovery.bank.copy()
            gone = [] if last else free_slots(done.discovery.discovery, bank)
            options = done.folder / KEPT
            bank.save(options)
            left -= done.discovery.num_timesteps
            self.folders.append(done.folder)
            learned = "yes" if learned_after(done.discovery.history) is not None else "no"
            kept = ", ".join(option.name for option in bank.slots if option is not None)
            row = name, f"{done.discovery.num_timesteps:,}", learned, kept or "–", ", ".join(gone) or "–"
            self.series = Series(whole, (*self.series.before, done.folder.name), (*self.series.rows, row))
            if done.interrupted or left <= 0:
                return
            if not (last or kept):
                self.console.print(
                    "No option to carry on: the task was learned before a subgoal was found. A shorter time limit "
                    "(max_steps) or a farther goal makes tasks that need one."
                )


def _reported(in_turn: _InTurn, resumed: tuple[TrainConfig, Path] | None) -> list[Path]:
    """Run it, and print what was done, however it ends."""
    console, folders, n_tasks = in_turn.console, in_turn.folders, len(in_turn.series.config.series)
    before = len(folders)
    try:
        in_turn.run(resumed)
    finally:
        if len(folders) > before:
            table = Table("task", "primitive steps", f"{IN_A_ROW} successes in a row", "options", "taken out")
            for row in in_turn.series.rows:
                table.add_row(*map(escape, row))
            console.print(table)
            console.print(f"Run folders:  {escape(', '.join(map(str, folders)))}")
        if len(folders) < n_tasks:
            console.print(f"Of {n_tasks} tasks {n_tasks - len(folders)} were not begun.")
    return folders
