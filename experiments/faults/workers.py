"""Worker processes that are killed again and again: does a loop of ``train.py resume`` end as if nothing had been?"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.faults.run_folder import ROOT
from experiments.kills.comparison import differences
from sb3_options.cli import TRY_AGAIN
from sb3_options.runs import folder as runs

ALGO = "ppo"
N_WORKERS = 16
FLAGS = ("--n-steps", "128", "--checkpoint-freq", "2048", "--eval-freq", "0", "--no-progress", "--device", "cpu")
"""128 steps of 16 environments are a rollout; with a checkpoint before each, little is lost by a kill."""

LOOK = 0.1
"""Seconds between two looks at a process."""

PATIENCE = 60.0
"""Seconds after its worker's end in which a training must have ended, on a busy machine."""


@dataclass
class Killed:
    """What became of a training whose workers were killed.

    Attributes:
        kills: Seconds of training before each kill.
        steps: Of the newest checkpoint at each kill.
        seconds_to_end: From each kill to the end of training.
        ended: How the processes ended: with one line and the status that says "try again", otherwise, or hanging.
        orphans: Processes that outlived the training that started them.
        checkpoints_lost: Kills after which a checkpoint that was whole before was not there any more.
    """

    kills: list[float] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    seconds_to_end: list[float] = field(default_factory=list)
    ended: dict[str, int] = field(default_factory=lambda: {"one line": 0, "otherwise": 0, "hanging": 0})
    orphans: int = 0
    checkpoints_lost: int = 0


def run(out: Path, n_timesteps: int, every: float, seed: int, n_workers: int = N_WORKERS) -> dict[str, Any]:
    """Train once alone and once with kills.

    Args:
        out: For both.
        n_timesteps: Primitive steps of all workers together.
        every: Seconds of training before a worker is killed; more, where no new checkpoint was written until then, so
            that a slow machine gets to the end as well.
        seed: Of training and of who is killed.
        n_workers: Worker processes.

    Returns:
        `Killed`, and the ``differences`` of what was left.
    """
    flags = [ALGO, "--n-envs", str(n_workers), "--vec-env", "subproc", "--seed", str(seed), *FLAGS]
    flags += ["--n-timesteps", str(n_timesteps)]
    alone = out / f"alone_{n_workers}_{n_timesteps}_{seed}"
    if not any(alone.glob(f"{ALGO}/*/{runs.MODEL}")):
        shutil.rmtree(alone, ignore_errors=True)
        subprocess.run(_command([*flags, "--tensorboard-log", str(alone)]), check=True, capture_output=True)
    shutil.rmtree(out / "killed", ignore_errors=True)
    killed = Killed()
    random = np.random.default_rng(seed)
    args = [*flags, "--tensorboard-log", str(out / "killed")]
    while not _to_its_end(args, out / "killed.log", killed, every, random):
        args = ["resume", str(_run_in(out / "killed")), "--no-progress"]
    differ = differences(_run_in(alone), _run_in(out / "killed"))
    return {
        "workers": n_workers,
        "n_timesteps": n_timesteps,
        "every": every,
        "times_killed": len(killed.kills),
        **asdict(killed),
        "differences": differ,
    }


def _command(args: list[str]) -> list[str]:
    return [sys.executable, "-W", "ignore", str(ROOT / "train.py"), *args]


def _run_in(folder: Path) -> Path:
    return next((folder / ALGO).iterdir())


def _to_its_end(args: list[str], log: Path, killed: Killed, every: float, random: np.random.Generator) -> bool:
    """Train, and kill a worker after ``every`` seconds, once there is a new checkpoint; whether it was over before.

    Raises:
        RuntimeError: Training failed for another reason.
    """
    with log.open("w", encoding="utf-8") as output:
        process = subprocess.Popen(_command(args), stdout=output, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and "Training " not in log.read_text(encoding="utf-8"):
        time.sleep(LOOK)
    began = time.monotonic()
    last = killed.steps[-1] if killed.steps else -1
    folder = log.with_suffix("")
    while process.poll() is None and (time.monotonic() < began + every or _checkpoints(folder)[-1:] <= [last]):
        time.sleep(LOOK)
    below = _below(process.pid)
    if process.poll() is not None or not (workers := _workers(below)):
        _, errors = process.communicate()
        if process.returncode != 0:
            raise RuntimeError(f"Training failed: {errors[-500:]}")
        return True
    before = _checkpoints(folder)
    killed.kills.append(time.monotonic() - began)
    killed.steps.append(before[-1])
    os.kill(workers[int(random.integers(len(workers)))], signal.SIGKILL)
    ended = time.monotonic()
    try:
        _, errors = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        killed.ended["hanging"] += 1
        process.kill()
        process.communicate()
        return False
    if process.returncode == 0:  # it was at its end already
        killed.kills.pop()
        killed.steps.pop()
        return True
    killed.seconds_to_end.append(time.monotonic() - ended)
    one_line = process.returncode == TRY_AGAIN and len(errors.strip().splitlines()) == 1 and " resume " in errors
    killed.ended["one line" if one_line else "otherwise"] += 1
    killed.orphans += sum(_is_there(pid) for pid in below)
    killed.checkpoints_lost += before[-1] not in _checkpoints(folder)
    return False


def _checkpoints(folder: Path) -> list[int]:
    """Steps of the checkpoints there are, oldest first."""
    return sorted(int(file.stem) for file in (_run_in(folder) / runs.CHECKPOINTS).glob("0*"))


def _workers(pids: list[int]) -> list[int]:
    """Those that have no process below them, and are no helper of Python's."""
    return [pid for pid in pids if not _below(pid) and "forkserver" in _text(pid, "cmdline")]


def _below(pid: int) -> list[int]:
    """All processes below one."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and (stat := _text(int(entry.name), "stat")):
            parents[int(entry.name)] = int(stat.rpartition(")")[2].split()[1])
    found = [child for child, parent in parents.items() if parent == pid]
    return found + [each for child in found for each in _below(child)]


def _is_there(pid: int) -> bool:
    """Whether a process runs, a moment after the one that started it has ended."""
    for _ in range(int(5 / LOOK)):
        stat = _text(pid, "stat")
        if not stat or stat.rpartition(")")[2].split()[0] == "Z":
            return False
        time.sleep(LOOK)
    return True


def _text(pid: int, name: str) -> str:
    try:
        return (Path("/proc") / str(pid) / name).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
