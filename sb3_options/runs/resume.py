"""Going on with a run that was cut off."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import yaml_file
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.users_code import IMPORTING


@dataclass(frozen=True)
class ResumeConfig:
    """Go on with a run that was killed or interrupted, from its last checkpoint, as if it had never ended.

    Attributes:
        run: The run folder that training named.
        env: Environment, module:Id, where the run had such a one.
        env_wrapper: Wrapper for it, module:Class; likewise.
        feature_map: Feature map φ, module:function; likewise.
        progress: Show a progress bar.
    """

    run: Annotated[Path, tyro.conf.Positional]
    env: str | None = None
    env_wrapper: str | None = None
    feature_map: str | None = None
    progress: bool = True


def config_of(resumed: ResumeConfig) -> TrainConfig:
    """The configuration of the run, as it goes on.

    The options it started with are in the checkpoint, and training without discovery has a folder of its own.

    Raises:
        FileNotFoundError: There is no run, or no checkpoint in it.
        ValueError: Its configuration names what would import a module, or something in it is a link or no file.
    """
    file = resumed.run / runs.CONFIG
    if not file.is_file():
        raise FileNotFoundError(f"{resumed.run} is no run folder: there is no {runs.CONFIG} in it.")
    _refuse_links(resumed.run)
    if not any(CheckpointFolder(resumed.run / runs.CHECKPOINTS)):
        raise FileNotFoundError(
            f"There is no checkpoint in {resumed.run} to go on from: it was cut off before its first one, or trained "
            "with --checkpoint-freq 0."
        )
    config = configs.load(file, {name: getattr(resumed, name) for name in IMPORTING})
    return dataclasses.replace(config, options=None, compare=False, progress=resumed.progress)


def options_of(run: Path) -> Path | None:
    """Where the options came from that a run started with."""
    options = yaml_file.read_mapping(run / runs.CONFIG).get("options")
    return None if options is None else Path(str(options))


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
