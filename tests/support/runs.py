"""Runs, as the command line trains them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_options.runs import training
from sb3_options.runs.config import TrainConfig, configure

Refused = Callable[..., str]  # the fixture `refused`: the words of a command, to what it says


def train(config: TrainConfig) -> Path:
    """Train, and return the run folder."""
    return training.train(config).folder


def trained(folder: Path, **values: Any) -> Path:
    """Train with these settings, and return the run folder, which is in ``folder``."""
    return train(configure(progress=False, device="cpu", tensorboard_log=folder, **values))
