"""Going on with a run that was cut off."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
import yaml
from rich.console import Console
from rich.markup import escape

from sb3_options.atomic import atomic_write
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import yaml_file
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.under_way import held
from sb3_options.runs.users_code import IMPORTING

FINISHED = f"{runs.CHECKPOINTS}/finished.yml"
"""File in a run folder whose training has come to its end."""


@dataclass(frozen=True)
class ResumeConfig:
    """Go on with a run that was killed or interrupted, from its last checkpoint, as if it had never ended.

    Attributes:
        run: The run folder that training named.
        n_timesteps: Train for so many primitive steps in all, more than the run was to; a finished run goes on, too.
        env: Environment, module:Id, where the run had such a one.
        env_wrapper: Wrapper for it, module:Class; likewise.
        feature_map: Feature map φ, module:function; likewise.
        progress: Show a progress bar.
    """

    run: Annotated[Path, tyro.conf.Positional]
    n_timesteps: int | None = None
    env: str | None = None
    env_wrapper: str | None = None
    feature_map: str | None = None
    progress: bool = True


def resume_run(resumed: ResumeConfig, train: Callable[..., Any], console: Console) -> None:
    """Go on with a run. A finished run is left as it is.

    Args:
        resumed: Which.
        train: Trains.
        console: For what is printed.

    Raises:
        OSError: There is no run, no checkpoint in it, or it cannot be written to.
        ValueError: Another process trains in it, or something does not fit.
        Otherwise as ``train``.
    """
    run = resumed.run
    if not (run / runs.CONFIG).is_file():
        raise FileNotFoundError(f"{run} is no run folder: there is no {runs.CONFIG} in it.")
    with held(run):
        config = config_of(resumed)
        if is_finished(config, run):
            console.print(f"{escape(str(run))} is finished: it has trained for {config.n_timesteps:,} primitive steps.")
            console.print("To train on, pass --n-timesteps with a larger number.")
        else:
            train(config, resumed=run)


def config_of(resumed: ResumeConfig) -> TrainConfig:
    """The configuration of the run, as it goes on.

    The options it started with are in the checkpoint.

    Raises:
        FileNotFoundError: There is no checkpoint in it.
        ValueError: Its configuration names what would import a module, something in it is a link or no file, or it is
            to be shorter than it was.
    """
    _refuse_links(resumed.run)
    if not any(CheckpointFolder(resumed.run / runs.CHECKPOINTS)):
        raise FileNotFoundError(
            f"There is no checkpoint in {resumed.run} to go on from: it was cut off before its first one, or trained "
            "with --checkpoint-freq 0."
        )
    config = configs.load(resumed.run / runs.CONFIG, {name: getattr(resumed, name) for name in IMPORTING})
    before = config.n_timesteps
    total = before if resumed.n_timesteps is None else resumed.n_timesteps
    if total < before:
        raise ValueError(f"--n-timesteps must be at least {before:,}, as {resumed.run} has it, got {total:,}.")
    return dataclasses.replace(config, n_timesteps=total, options=None, progress=resumed.progress)


def mark_finished(config: TrainConfig, run: Path) -> None:
    """Note in a run folder that training has come to its end; without checkpoints there is nothing to note."""
    file = run / FINISHED
    if file.parent.is_dir():
        with atomic_write(file) as temporary:
            temporary.write_text(f"n_timesteps: {config.n_timesteps}\n", encoding="utf-8")


def is_finished(config: TrainConfig, run: Path) -> bool:
    """Whether a run has trained for as long as it is to."""
    if not ((run / FINISHED).is_file() and (run / runs.MODEL).is_file()):
        return False
    trained = yaml_file.read_mapping(run / FINISHED).get("n_timesteps")
    return isinstance(trained, int) and trained >= config.n_timesteps


def lengthen(run: Path, n_timesteps: int) -> None:
    """Have the configuration of a run say that it trains for longer, so that the next `resume` goes on with that.

    Raises:
        OSError: It cannot be written.
    """
    content = yaml_file.read_mapping(run / runs.CONFIG)
    if content.get("n_timesteps") != n_timesteps:
        with atomic_write(run / runs.CONFIG) as temporary:
            temporary.write_text(
                yaml.safe_dump(content | {"n_timesteps": n_timesteps}, sort_keys=False), encoding="utf-8"
            )


def _refuse_links(run: Path) -> None:
    """Keep what training cuts, appends to and removes inside the run folder, which a stranger may have made.

    Raises:
        ValueError: Something in it is a link, or neither a file nor a folder.
    """
    for path in run.rglob("*"):
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise ValueError(
                f"{path} is a link, or neither a file nor a folder. Training would write to what it leads to. Put a "
                "copy in its place to go on with this run."
            )
