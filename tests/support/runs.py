"""Runs, as the command line trains them."""

from pathlib import Path

from sb3_options.runs import training
from sb3_options.runs.config import TrainConfig


def train(config: TrainConfig) -> Path:
    """Train, and return the run folder."""
    return training.train(config).folder
