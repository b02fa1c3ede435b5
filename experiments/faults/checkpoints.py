"""Damaged checkpoints: is each refused, or passed over for the one before?"""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import numpy as np

from experiments.faults.files import damaged
from experiments.faults.run_folder import train
from experiments.kills.states import differing
from sb3_options.checkpoints.file import BLOCKS, CheckpointFolder, read
from sb3_options.checkpoints.tree import State
from sb3_options.runs import folder as runs

FLAGS = ("--n-timesteps", "12000", "--checkpoint-freq", "4000", "--eval-freq", "0")
"""Of a DQN training whose last checkpoints share blocks of the replay buffer, and each has some of its own."""

MISSING = 0.1
SWAPPED = 0.1
"""Shares of the damages by which a file is gone, or two have each other's content; the others are in one file."""


def folder_with_checkpoints(out: Path) -> Path:
    """The checkpoints of a training below ``out``, trained if it is not there yet.

    Raises:
        RuntimeError: Training failed.
    """
    found = sorted(out.glob(f"dqn/*/{runs.MODEL}")) if out.exists() else []
    if not found:
        done = train(out, *FLAGS, algo="dqn")
        if done.returncode:
            raise RuntimeError(f"Training failed: {done.stderr[-500:]}")
        found = sorted(out.glob(f"dqn/*/{runs.MODEL}"))
    return found[-1].parent / runs.CHECKPOINTS


def check(folder: Path, n: int, random: np.random.Generator) -> dict[str, dict[str, int]]:
    """Damage the newest checkpoint ``n`` times, its file or one of its blocks in turns, and look for the newest.

    Returns:
        For ``file`` and ``block`` how often: ``passed over``, the one before was read, whole; ``refused``, a
        ``ValueError`` named a checkpoint, because the one before needs the same block; ``unharmed``, the newest was
        read, and is what it was; ``wrong``, something else was read; ``error``, any other exception.
    """
    copy = folder.with_name("damaged")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    newest, before = list(CheckpointFolder(copy))[:2]
    whole = {path: read(path) for path in (newest, before)}
    blocks = sorted((copy / BLOCKS).iterdir())
    counts: dict[str, Counter[str]] = {"file": Counter(), "block": Counter()}
    for number in range(n):
        what = "file" if number % 2 == 0 else "block"
        path = newest if what == "file" else blocks[int(random.integers(len(blocks)))]
        kept = {each: each.read_bytes() for each in (path, *_other(path, blocks, random))}
        _damage(path, list(kept), random)
        counts[what][_outcome(copy, whole)] += 1
        for each, content in kept.items():
            each.write_bytes(content)
    shutil.rmtree(copy)
    return {what: dict(sorted(of.items())) for what, of in counts.items()}


def _other(path: Path, blocks: list[Path], random: np.random.Generator) -> list[Path]:
    """Another block, whose content may come in the place of this file's."""
    others = [block for block in blocks if block != path]
    return [others[int(random.integers(len(others)))]]


def _damage(path: Path, both: list[Path], random: np.random.Generator) -> None:
    draw = random.random()
    if draw < MISSING:
        path.unlink()
    elif draw < MISSING + SWAPPED:
        first, second = (each.read_bytes() for each in both)
        both[0].write_bytes(second)
        both[1].write_bytes(first)
    else:
        path.write_bytes(damaged(path.read_bytes(), random)[1])


def _outcome(folder: Path, whole: dict[Path, State]) -> str:
    before = list(whole)[1]
    try:
        path, state = CheckpointFolder(folder).newest()
    except ValueError as error:
        return "refused" if any(str(each) in str(error) for each in whole) else "error"
    except Exception:
        return "error"
    if differing(state, whole[path]):
        return "wrong"
    return "passed over" if path == before else "unharmed"
