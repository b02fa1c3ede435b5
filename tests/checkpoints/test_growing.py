"""Of an array that grows, a checkpoint reads the new rows only, and holds all of them."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_options.checkpoints import file as checkpoint_file
from sb3_options.checkpoints.file import CheckpointFolder, read
from sb3_options.learning.replay_buffer import Growing

CAPACITY, WIDTH, PER_BLOCK = 100, 16, 8


class Ring:
    """Rows that are written one after another, round and round."""

    def __init__(self) -> None:
        self.array = np.zeros((CAPACITY, WIDTH))
        self.changed_at = np.zeros(CAPACITY, dtype=np.int64)
        self.written = self.changes = 0

    @property
    def stored(self) -> np.ndarray[Any, Any]:
        return self.array[: min(self.written, CAPACITY)]

    def put(self, rows: Any, values: Any) -> None:
        self.changes += 1
        self.array[rows] = values
        self.changed_at[rows] = self.changes

    def write(self, n: int) -> None:
        for _ in range(n):
            self.written += 1
            self.put((self.written - 1) % CAPACITY, self.written)

    def growing(self) -> list[Growing]:
        return [Growing(self.array, self.changed_at, self.changes)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CheckpointFolder:
    monkeypatch.setattr(checkpoint_file, "BLOCK_BYTES", PER_BLOCK * WIDTH * 8)
    return CheckpointFolder(tmp_path / "checkpoints")


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Bytes of each block that was read; whoever looks clears it."""
    found: list[int] = []
    sha256 = hashlib.sha256

    def counted(content: Any = b"") -> Any:
        found.append(len(memoryview(content).cast("B")) if isinstance(content, memoryview) else 0)
        return sha256(content)

    monkeypatch.setattr(hashlib, "sha256", counted)
    return found


def test_whatever_was_written_is_in_the_checkpoint(folder: CheckpointFolder, rng: np.random.Generator) -> None:
    ring = Ring()
    for step in range(40):
        ring.write(int(rng.choice([0, 1, 3, PER_BLOCK, 37, CAPACITY - 1, CAPACITY, 2 * CAPACITY + 5])))
        if rng.random() < 0.1:  # as where a slot was emptied
            ring.put(rng.integers(CAPACITY, size=5), -1)
        file = folder.save(step, {"rows": ring.stored}, growing=ring.growing())
        np.testing.assert_array_equal(read(file)["rows"], ring.stored)


def test_only_blocks_with_new_rows_are_read(folder: CheckpointFolder, hashed: list[int]) -> None:
    ring = Ring()
    ring.write(90)
    folder.save(1, {"rows": ring.stored}, growing=ring.growing())
    hashed.clear()
    ring.write(15)  # rows 90 … 99 and 0 … 4
    folder.save(2, {"rows": ring.stored}, growing=ring.growing())
    row = WIDTH * 8
    assert sorted(n for n in hashed if n) == sorted([4 * row, PER_BLOCK * row, PER_BLOCK * row])


def test_other_arrays_are_not_taken_for_the_ones_before(folder: CheckpointFolder) -> None:
    ring = Ring()
    ring.write(40)
    folder.save(1, {"rows": ring.stored}, growing=ring.growing())
    other = Ring()
    other.write(40)
    other.array[0] = 7
    file = folder.save(2, {"rows": other.stored}, growing=other.growing())
    np.testing.assert_array_equal(read(file)["rows"], other.stored)
