"""The state of a `VecMonitor`: the episodes under way, and its file."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecMonitor

from sb3_options.checkpoints.tree import State


def get_state(monitor: VecMonitor) -> State:
    """Between two steps. The whole file is in it: a `VecMonitor` that is made again begins its file anew."""
    writer = monitor.results_writer
    return {
        "elapsed": time.time() - monitor.t_start,
        "episode_count": monitor.episode_count,
        "returns": monitor.episode_returns.copy(),
        "lengths": monitor.episode_lengths.copy(),
        "file": None if writer is None else np.frombuffer(Path(writer.file_handler.name).read_bytes(), dtype=np.uint8),
    }


def set_state(monitor: VecMonitor, state: State) -> None:
    """Go on with what `get_state` gave; the file holds what it held then."""
    monitor.t_start, monitor.episode_count = time.time() - state["elapsed"], state["episode_count"]
    monitor.episode_returns, monitor.episode_lengths = state["returns"], state["lengths"]
    if monitor.results_writer is not None and state["file"] is not None:
        file: Any = monitor.results_writer.file_handler  # a text file, which typeshed does not say
        file.seek(0)
        file.truncate()
        file.write(state["file"].tobytes().decode())
        file.flush()
