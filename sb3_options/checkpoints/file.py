"""The files of checkpoints: safetensors for arrays, JSON for the rest, and shared blocks of large arrays.

An array larger than `BLOCK_BYTES` is cut into blocks of rows. Each block is a file named by the SHA-256 of its content.
A block unchanged since the last checkpoint already exists, and is not written again.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from safetensors import safe_open
from safetensors.numpy import load as from_safetensors
from safetensors.numpy import save as to_safetensors

from sb3_options.atomic import atomic_write
from sb3_options.checkpoints.tree import State, decode, encode
from sb3_options.learning.replay_buffer import Growing
from sb3_options.options.sealed import DAMAGE, errors_of, sealed, unsealed

FORMAT = "sb3-options checkpoint 1"

BLOCK_BYTES = 1 << 20  # largest block: a checkpoint writes at most about this much of an unchanged array

MOST_REPETITIONS = 16
MOST_REPEATED_BYTES = 1 << 30
"""A checkpoint may repeat blocks (rows of zeros), up to this many times their size, plus this many bytes."""

BLOCKS = "blocks"  # folder of the blocks, beside the checkpoints

SUFFIX = ".safetensors"

KEPT = 2  # number of checkpoints kept

_NAME = re.compile(r"[0-9a-f]{64}")


class CheckpointFolder:
    """Checkpoints of one run, by primitive steps taken. The first one creates the folder."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._known = KnownBlocks()

    def __iter__(self) -> Iterator[Path]:
        """Iterate over checkpoints, newest first, including damaged ones."""
        found = [file for file in self.path.glob(f"*{SUFFIX}") if file.stem.isdecimal()]
        return iter(sorted(found, key=lambda file: int(file.stem), reverse=True))

    def save(self, steps: int, state: State, *, growing: Sequence[Growing] = ()) -> Path:
        """Write a checkpoint, and remove all but the last `KEPT`.

        A killed process or a full disk leaves older checkpoints intact.
        """
        blocks = self.path / BLOCKS
        blocks.mkdir(parents=True, exist_ok=True)
        known = KnownBlocks(growing, self._known)
        content, arrays = encode(state)
        large = {number: _cut(a, blocks, known) for number, a in arrays.items() if a.nbytes > BLOCK_BYTES}
        small = {number: array for number, array in arrays.items() if number not in large}
        packed = sealed(FORMAT, {"state": content, "blocks": large}, small)
        _sync(blocks)
        file = self.path / f"{steps:012d}{SUFFIX}"
        with atomic_write(file) as temporary:
            temporary.write_bytes(packed)
        _sync(self.path)
        self._known = known
        self._remove_old()
        return file

    def newest(self) -> tuple[Path, State]:
        """Return the newest undamaged checkpoint."""
        wrong: ValueError | None = None
        for file in self:
            try:
                return file, read(file)
            except ValueError as error:
                wrong = wrong or error
        if wrong is not None:
            raise ValueError(
                f"{str(wrong).rstrip('.')}. No other checkpoint in {self.path} is whole: train anew, in a new folder, "
                "with the same settings."
            ) from wrong
        raise FileNotFoundError(f"There is no checkpoint in {self.path}.")

    def make_room(self) -> None:
        """Free space on a full disk: remove all but the newest checkpoint, and any from before the first step."""
        for i, file in enumerate(self):
            if i or int(file.stem) == 0:
                file.unlink()
        if (self.path / BLOCKS).is_dir():
            self._remove_old()

    def _remove_old(self) -> None:
        files = list(self)
        for file in files[KEPT:]:
            file.unlink()
        try:
            used = {name for file in files[:KEPT] for name in _block_names(file)}
        except DAMAGE:
            return  # somebody may want to look at a damaged file: its blocks stay
        for path in (self.path / BLOCKS).iterdir():
            if path.stem not in used:  # also removes leftovers of killed processes
                path.unlink()
        for path in self.path.glob(f".*{SUFFIX}"):
            path.unlink()


def read(file: Path) -> State:
    """Return the state in a checkpoint. No code of the file runs."""
    with errors_of(str(file), "is no checkpoint, or it is damaged"):
        parts, arrays = unsealed(file.read_bytes(), FORMAT)
        large = parts["blocks"]
        _check_sizes(large, file.parent / BLOCKS)
        for number, about in large.items():
            arrays[number] = _joined(about, file.parent / BLOCKS)
        state = decode(parts["state"], arrays)
        if not isinstance(state, dict):
            raise ValueError("it holds no state")
    return state


def _cut(rows: npt.NDArray[Any], folder: Path, known: KnownBlocks) -> State:
    """Write the missing blocks of an array, and return shape, dtype and names of all blocks."""
    n = max(1, BLOCK_BYTES * len(rows) // rows.nbytes)
    names = []
    unchanged = known.unchanged(rows, n)
    for start in range(0, len(rows), n):
        if start in unchanged and (folder / f"{unchanged[start]}{SUFFIX}").is_file():
            names.append(unchanged[start])
            continue
        block = rows[start : start + n]
        name = hashlib.sha256(block.data).hexdigest()
        names.append(name)
        if not (folder / f"{name}{SUFFIX}").is_file():
            with atomic_write(folder / f"{name}{SUFFIX}") as temporary:
                temporary.write_bytes(to_safetensors({"rows": block}))
    known.keep(rows, n, names)
    return {"shape": list(rows.shape), "dtype": rows.dtype.str, "names": names}


def _check_sizes(large: dict[str, State], folder: Path) -> None:
    """Refuse arrays larger than their blocks, and more repetitions of blocks than training produces."""
    sizes: dict[str, int] = {}
    total = 0
    for about in large.values():
        for name in set(about["names"]):
            if not _NAME.fullmatch(name):
                raise ValueError(f"{name!r} is no name of a block")
            sizes[name] = (folder / f"{name}{SUFFIX}").stat().st_size
        declared = math.prod(about["shape"]) * np.dtype(about["dtype"]).itemsize
        if declared > sum(sizes[name] for name in about["names"]):
            raise ValueError(f"its blocks are too small for an array of shape {about['shape']}")
        total += sum(sizes[name] for name in about["names"])
    if total > MOST_REPEATED_BYTES + MOST_REPETITIONS * sum(sizes.values()):
        raise ValueError(f"its blocks of {sum(sizes.values()):,} bytes are to be read as {total:,} bytes")


def _joined(about: State, folder: Path) -> npt.NDArray[Any]:
    rows = np.empty(about["shape"], about["dtype"])
    start = 0
    for name in about["names"]:
        block = from_safetensors((folder / f"{name}{SUFFIX}").read_bytes())["rows"]
        if hashlib.sha256(np.ascontiguousarray(block).data).hexdigest() != name:
            raise ValueError(f"the contents of its block {name} are not what was written to it")
        rows[start : start + len(block)] = block
        start += len(block)
    if start != len(rows):
        raise ValueError(f"its blocks have {start} rows, expected {len(rows)}")
    return rows


def _block_names(file: Path) -> list[str]:
    """Return the names of a checkpoint's blocks."""
    with safe_open(file, framework="np") as opened:
        large = json.loads(opened.metadata()["blocks"])
    return [name for about in large.values() for name in about["names"]]


def _sync(folder: Path) -> None:
    """Flush the names in a folder to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:
        pass  # some file systems cannot
    finally:
        os.close(descriptor)


class _Written(NamedTuple):
    array: weakref.ref[npt.NDArray[Any]]
    changes: int
    per_block: int
    names: list[str]


class KnownBlocks:
    """The block names of the last checkpoint, for arrays that record which rows have changed."""

    def __init__(self, growing: Sequence[Growing] = (), before: KnownBlocks | None = None) -> None:
        self._growing = {_address(each.array): each for each in growing}
        self._before = {} if before is None else before._written
        self._written: dict[int, _Written] = {}

    def unchanged(self, rows: npt.NDArray[Any], per_block: int) -> dict[int, str]:
        """Return the names of unchanged blocks, by their first row."""
        now, then = self._growing.get(_address(rows)), self._before.get(_address(rows))
        if now is None or then is None or then.array() is not now.array or then.per_block != per_block:
            return {}
        starts = range(0, len(rows), per_block)
        changed_at = np.maximum.reduceat(now.changed_at[: len(rows)], starts)
        known = zip(starts, then.names, changed_at, strict=False)  # by now there may be more or fewer rows
        return {start: name for start, name, at in known if at <= then.changes}

    def keep(self, rows: npt.NDArray[Any], per_block: int, names: list[str]) -> None:
        """Remember the blocks of an array, if it records its changes."""
        now = self._growing.get(_address(rows))
        if now is not None:
            self._written[_address(rows)] = _Written(weakref.ref(now.array), now.changes, per_block, names)


def _address(array: npt.NDArray[Any]) -> int:
    return int(np.asarray(array).__array_interface__["data"][0])
