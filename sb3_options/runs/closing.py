"""What training says of itself at its end, beside the same training without discovery."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.discovery.discovery import Discovery
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.options.bank import OptionBank
from sb3_options.runs import folder as runs
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.users_code import flag, importing

LAST = 100
"""Episodes at the end of training that are averaged."""

IN_A_ROW = 20
"""Successes in a row by which a task counts as learned."""

PROGRAM, SCRIPT = "train.py", "sb3-options"


class Discovering(Protocol):
    """What is asked of a `SubgoalDiscoveryCallback` after training."""

    history: list[EpisodeRecord]
    max_new_options: int | None
    num_timesteps: int

    @property
    def bank(self) -> OptionBank:
        """The slots."""

    @property
    def discovery(self) -> Discovery | None:
        """Of the training."""


class Trained(NamedTuple):
    """What is left of one training.

    Attributes:
        config: Of the run.
        folder: The run folder, which is gone if no step was taken.
        discovery: The callback.
        finished: Whether training came to its end.
        interrupted: Whether there was an interrupt, perhaps after the end, so that no other training is to begin.
    """

    config: TrainConfig
    folder: Path
    discovery: Discovering
    finished: bool
    interrupted: bool


def report(console: Console, trained: Trained, without_discovery: Trained | None, *, draws: bool) -> None:
    """Print how training went, beside the same without discovery where that is finished, and the commands that follow.

    Args:
        console: Where to.
        trained: The run.
        without_discovery: What ``--compare`` trained after it; None where that was not begun.
        draws: Whether the environment draws pictures, of which a video can be made.
    """
    config, histories = trained.config, {"this run": trained.discovery.history}
    both = without_discovery is not None and without_discovery.finished
    if without_discovery is not None and both:
        histories["--no-discover"] = without_discovery.discovery.history
    console.print(closing_table(histories))
    if both:
        console.print("Both trained for as many primitive steps on the same seed. That is one seed, and no study.")
    elif without_discovery is not None:
        steps = f"{without_discovery.discovery.num_timesteps:,} of {config.n_timesteps:,} primitive steps"
        console.print(f"The run without discovery was interrupted after {steps}.")
    elif trained.discovery.max_new_options != 0 and not config.compare:
        console.print("Against --no-discover: train with --compare, which trains once more without discovery.")
    next_commands(console, config, trained.folder, draws=draws)
    last = without_discovery or trained
    goes_on = not last.finished and after_interrupt(console, last.config, last.folder, last.discovery.num_timesteps)
    if config.compare and config.discover and not both:
        _how_to_compare(console, config, trained.folder, last.folder if without_discovery and goes_on else None)


def _how_to_compare(console: Console, config: TrainConfig, folder: Path, other: Path | None) -> None:
    """Print how to set the run without discovery beside the run.

    Args:
        console: Where to.
        config: Of the run.
        folder: Its run folder.
        other: The one without discovery, which can be resumed; None where it is to be trained from its start.
    """
    run, beside = (_quoted(each) for each in (folder, other or Path("FOLDER")))
    if other is None:
        options = "" if runs.options_of(folder) is None else " --options None"
        words = f"--config {run} --no-discover --no-compare{options}{_importing(config)}"
        console.print(f"No discovery: {escape(f'{_command()} {words}')}")
        beside += "  # the run folder that the line above names when it ends"
    console.print(f"Then compare: {escape(f'{_command()} compare {run} {beside}')}")


def closing_table(histories: Mapping[str, Sequence[EpisodeRecord]]) -> Table:
    """Return, success and length of training episodes, exploration included.

    Args:
        histories: Of every training, the episodes in the order in which they ended, by the heading of its column.

    Returns:
        A row for each measure, a column for each training; "–" where there is nothing to average.
    """
    table = Table("", *histories)
    columns = [measures(history) for history in histories.values()]
    for name in columns[0]:
        table.add_row(name, *(column[name] for column in columns))
    return table


def measures(history: Sequence[EpisodeRecord]) -> dict[str, str]:
    """What is said of training episodes, by name."""
    last, learned = history[-LAST:], learned_after(history)
    return {
        f"return, last {LAST} episodes": _mean([e.total_reward for e in last]),
        f"success rate, last {LAST} episodes": _mean([e.success for e in last]),
        f"primitive steps, last {LAST} episodes": _mean([e.steps for e in last]),
        "return, all episodes": _mean([e.total_reward for e in history]),
        "success rate, all episodes": _mean([e.success for e in history]),
        "primitive steps, all episodes": _mean([e.steps for e in history]),
        "episodes": f"{len(history):,}",
        f"{IN_A_ROW} successes in a row after": "–" if learned is None else f"{learned:,} steps",
    }


def _mean(values: Sequence[float]) -> str:
    return f"{np.mean(values):,.4g}" if values else "–"


def learned_after(history: Sequence[EpisodeRecord]) -> int | None:
    """Primitive steps until a task counted as learned; None if it never did."""
    in_a_row = 0
    for episode in history:
        in_a_row = in_a_row + 1 if episode.success else 0
        if in_a_row == IN_A_ROW:
            return episode.timestep
    return None


def unit_of(config: TrainConfig) -> str:
    """What trajectories are: episodes, or segments of a continuing task."""
    return "episode" if config.discovery.segmentation == "episodes" else "segment"


def next_commands(console: Console, config: TrainConfig, folder: Path, *, draws: bool = True) -> None:
    """Print the run folder and the commands that look at it.

    Args:
        console: Where to.
        config: Of the run.
        folder: The run folder.
        draws: Whether the environment draws pictures, of which a video can be made.
    """
    console.print(f"Run folder:   {escape(str(folder))}")
    path = escape(shlex.quote(str(folder)))
    python = escape(_python())
    console.print(f"TensorBoard:  {python} -m tensorboard.main --logdir {path}")
    video = f" --video {shlex.quote(f'{folder}/video.mp4')}" if draws else ""
    console.print(f"Evaluate:     {escape(_command())} evaluate {path}{escape(video + _importing(config))}")
    if (folder / runs.BEST).is_file():
        console.print("Best model:   add --best; it is the one whose evaluation gave the highest return")


def after_interrupt(console: Console, config: TrainConfig, folder: Path, steps: int) -> bool:
    """Print how to go on, where there is a checkpoint.

    Args:
        console: Where to.
        config: Of the run.
        folder: The run folder.
        steps: Primitive steps that were trained.

    Returns:
        Whether there is one.
    """
    there = next(iter(CheckpointFolder(folder / runs.CHECKPOINTS)), None)
    if there is None:
        return False
    since = int(there.stem)
    if since < steps:
        console.print(f"The last checkpoint is of {since:,} primitive steps: what came after it is trained again.")
    console.print(f"Resume:       {escape(_resume(config, folder))}")
    return True


def how_to_resume(config: TrainConfig, folder: Path) -> str:
    """The command that goes on from a run's last checkpoint; empty where there is none.

    Args:
        config: Of the run.
        folder: The run folder.
    """
    if not any(CheckpointFolder(folder / runs.CHECKPOINTS)):
        return ""
    return f"Go on from its last checkpoint: {_resume(config, folder)}"


def _resume(config: TrainConfig, folder: Path) -> str:
    return f"{_command()} resume {_quoted(folder)}{_importing(config)}"


def _importing(config: TrainConfig) -> str:
    """The flags that import a module, which are named anew: the file of a run is not trusted with it."""
    return "".join(f" {flag(n)} {shlex.quote(t)}" for n, t in importing(vars(config)).items())


def _python() -> str:
    """What to type for this interpreter: it may be in a virtual environment that nobody activated."""
    if shutil.which("python") == sys.executable:
        return "python"
    return shlex.quote(_shortest(sys.executable))


def program_name() -> str:
    """``sb3-options`` where that was called, or ``python -m sb3_options``; else ``train.py``."""
    return SCRIPT if Path(sys.argv[0]).stem in (SCRIPT, "__main__") else PROGRAM


def _command() -> str:
    """What to type before a command. A run may be started from another folder, or by a script that is in no path."""
    called = Path(sys.argv[0])
    if called.stem == SCRIPT:
        return SCRIPT if shutil.which(SCRIPT) == str(called.absolute()) else shlex.quote(_shortest(str(called)))
    if program_name() == SCRIPT:
        return f"{_python()} -m sb3_options"
    return f"{_python()} {shlex.quote(_shortest(str(called.absolute()))) if called.name == PROGRAM else PROGRAM}"


def _quoted(path: Path) -> str:
    return shlex.quote(_shortest(str(path)))


def _shortest(path: str) -> str:
    return min(path, os.path.relpath(path), key=len)
