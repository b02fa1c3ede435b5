"""A disk that is full: is anything lost that was whole before?"""

from __future__ import annotations

import os
import resource
import subprocess
import tempfile
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from sb3_contrib import MaskablePPO

from experiments.common.seeds import write_json
from experiments.faults.run_folder import RunFolder, train
from sb3_options.options.bank import OptionBank
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs

Write = Callable[[Path], object]
Counts = dict[str, int]

N_TIMESTEPS = 2_000
"""Of each training on a full disk."""

ROOM = 1.1
"""The largest disk, as a share of what a training writes."""


@contextmanager
def files_end_at(n_bytes: int) -> Iterator[None]:
    """No file of this process can grow beyond ``n_bytes``: a write there fails as on a full disk (``EFBIG``)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def writers(run: RunFolder) -> dict[str, Write]:
    """What writes each kind of file that a user would miss, by its name."""
    bank = OptionBank(run.n_primitive, run.max_options)
    bank.load(run.path / runs.OPTIONS)
    model = MaskablePPO.load(run.path / runs.MODEL, device="cpu")
    config = configs.load(run.path / runs.CONFIG)
    return {
        runs.OPTIONS: bank.save,
        runs.MODEL: lambda path: runs.save_whole(model, path),
        runs.CONFIG: lambda path: configs.save(config, path),
        "results.json": lambda path: write_json(path, {"numbers": list(range(1000))}),
    }


def overwrite(name: str, write: Write, n: int) -> Counts:
    """Write over a whole file ``n`` times, on disks that are full after 0 … all but one of its bytes.

    Returns:
        ``kept``: an ``OSError`` was raised, the older file is what it was, and nothing else is left; ``lost``: it is
        not; ``silent``: no error.
    """
    counts: Counter[str] = Counter(kept=0, lost=0, silent=0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        old = path.read_bytes()
        for offset in np.linspace(0, len(old) - 1, n).astype(int):
            try:
                with files_end_at(int(offset)):
                    write(path)
            except OSError:
                kept = path.read_bytes() == old and [entry.name for entry in Path(folder).iterdir()] == [name]
                counts["kept" if kept else "lost"] += 1
            else:
                counts["silent"] += 1
    return dict(counts)


def trainings(run: RunFolder, n: int) -> dict[str, Any]:
    """Train ``n`` times on small disks, from next to nothing to nearly enough.

    Where this user may mount one, a disk is a tmpfs of that size, which all files share; else no single file may grow
    beyond the size.

    Returns:
        ``disk``: which; and how many trainings ended ``well``, with ``one sentence``, with a ``traceback``; how many
        left a ``model``, and how many left a file that is ``damaged`` or ``temporary``.
    """
    counts: Counter[str] = Counter(dict.fromkeys(("well", "one sentence", "traceback", *LEFT), 0))
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        _train(run, whole, None)
        files = [path.stat().st_size for path in whole.rglob("*") if path.is_file()]
        mounted = _mounted(Path(folder) / "try", 1 << 16)
        if mounted:
            _unmount(Path(folder) / "try")
        largest = ROOM * (sum(files) if mounted else max(files))
        for number, size in enumerate(np.linspace(1 << 12, largest, n).astype(int)):
            out = Path(folder) / str(number)
            if mounted:
                _mounted(out, int(size))
            try:
                done = _train(run, out, None if mounted else int(size))
                how = "traceback" if "Traceback" in done.stderr else "one sentence" if done.returncode else "well"
                counts.update([how, *_left(out, run)])
            finally:
                if mounted:
                    _unmount(out)
    return {"disk": "tmpfs" if mounted else "limit of every file", **counts}


LEFT = ("model", "damaged", "temporary")


def _train(run: RunFolder, out: Path, limit: int | None) -> subprocess.CompletedProcess[str]:
    def before() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return train(out, "--options", str(run.path), "--n-timesteps", str(N_TIMESTEPS), before=before)


def _left(out: Path, run: RunFolder) -> list[str]:
    """Which of `LEFT` there is."""
    left = set()
    for path in out.rglob("*"):
        if path.name.startswith("."):
            left.add("temporary")
        elif path.name in (runs.MODEL, runs.OPTIONS, runs.CONFIG):
            try:
                if path.name == runs.CONFIG:
                    configs.load(path)
                else:
                    OptionBank(run.n_primitive, run.max_options).load(path)
                if path.name == runs.MODEL:
                    with zipfile.ZipFile(path) as archive:
                        left.add("damaged" if archive.testzip() else "model")
            except ValueError:
                left.add("damaged")
    return sorted(left)


def _mounted(folder: Path, n_bytes: int) -> bool:
    """Mount a tmpfs; whether that is allowed."""
    if os.geteuid() != 0:
        return False
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={n_bytes}", "none", str(folder)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def _unmount(folder: Path) -> None:
    subprocess.run(["umount", str(folder)], check=True)
