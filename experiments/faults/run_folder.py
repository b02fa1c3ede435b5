"""A real run of ``train.py``, whose files the faults are tried on."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sb3_options.options.file import opened
from sb3_options.runs.folder import OPTIONS

ROOT = Path(__file__).parents[2]
ALGO, ENV = "maskableppo", "sb3_options/TwoRooms-v0"
N_TIMESTEPS = 12_000
"""Enough for an option."""

SEED = 1


@dataclass(frozen=True)
class RunFolder:
    """A run that has an option.

    Attributes:
        path: Its folder.
        n_primitive: Primitive actions of its task.
        max_options: Its slots.
    """

    path: Path
    n_primitive: int = 4
    max_options: int = 4


def train(
    out: Path, *flags: str, algo: str = ALGO, before: Callable[[], None] | None = None
) -> subprocess.CompletedProcess[str]:
    """A real training, in a process of its own.

    Args:
        out: ``--tensorboard-log``.
        flags: More of them.
        algo: Which algorithm.
        before: What the process does before it begins.
    """
    command = [sys.executable, "-W", "ignore", str(ROOT / "train.py"), algo, "--env", ENV, "--no-progress"]
    command += ["--seed", str(SEED), "--device", "cpu", "--tensorboard-log", str(out), *flags]
    return subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=before)


def run_folder(out: Path) -> RunFolder:
    """The run below ``out``, trained if it is not there yet.

    Raises:
        RuntimeError: Training failed, or discovered nothing.
    """
    found = sorted(out.glob(f"{ALGO}/*/{OPTIONS}")) if out.exists() else []
    if not found:
        done = train(out, "--n-timesteps", str(N_TIMESTEPS))
        if done.returncode:
            raise RuntimeError(f"Training failed: {done.stderr[-500:]}")
        found = sorted(out.glob(f"{ALGO}/*/{OPTIONS}"))
    if not opened(found[-1]).slots:
        raise RuntimeError(f"The run in {found[-1].parent} discovered nothing: there is nothing to damage.")
    return RunFolder(found[-1].parent)
