"""Runs, as the command line trains them."""

from collections.abc import Callable
from pathlib import Path

from sb3_options.runs import training
from sb3_options.runs.config import TrainConfig

Refused = Callable[..., str]  # the fixture `refused`: the words of a command, to what it says


def train(config: TrainConfig) -> Path:
    """Train, and return the run folder."""
    return training.train(config).folder
