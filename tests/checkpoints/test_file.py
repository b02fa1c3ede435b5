import errno
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_options.checkpoints import file as checkpoint_file
from sb3_options.checkpoints.file import BLOCKS, CheckpointFolder, read
from sb3_options.options.sealed import sealed

SMALL_BLOCKS = 1 << 10


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CheckpointFolder:
    monkeypatch.setattr(checkpoint_file, "BLOCK_BYTES", SMALL_BLOCKS)
    return CheckpointFolder(tmp_path / "checkpoints")


def blocks(folder: CheckpointFolder) -> set[str]:
    return {path.name for path in (folder.path / BLOCKS).iterdir()}


def large(n: int = 1000) -> np.ndarray[Any, Any]:
    return np.arange(4.0 * n).reshape(n, 4)


def test_a_state_comes_back(folder: CheckpointFolder) -> None:
    rows = large()
    folder.save(7, {"rows": rows, "small": np.ones(2), "text": "é"})
    file, state = folder.newest()
    assert file.name == "000000000007.safetensors"
    np.testing.assert_array_equal(state["rows"], rows)
    assert state["text"] == "é"


def test_blocks_that_did_not_change_are_not_written_again(
    folder: CheckpointFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = large()
    folder.save(1, {"rows": rows})
    before = blocks(folder)
    rows[-1] += 1
    folder.save(2, {"rows": rows})
    assert len(blocks(folder) - before) == 1
    folder.save(3, {"rows": np.concatenate([rows, rows[:3]])})
    np.testing.assert_array_equal(read(next(iter(folder)))["rows"][-3:], rows[:3])


def test_keeps_the_last_two_with_their_blocks(folder: CheckpointFolder) -> None:
    for step in range(5):
        folder.save(step, {"rows": large() + step, "step": step})
    assert [int(file.stem) for file in folder] == [4, 3]
    for file, step in zip(folder, (4, 3), strict=True):
        state = read(file)
        assert state["step"] == step
        np.testing.assert_array_equal(state["rows"], large() + step)
    assert len(blocks(folder)) == 2 * len(range(0, large().nbytes, SMALL_BLOCKS))


@pytest.mark.parametrize("writes", range(1, 5))
def test_a_full_disk_leaves_the_last_checkpoint_whole(
    folder: CheckpointFolder, writes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.save(1, {"rows": large(100), "step": 1})
    left, write = writes, Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        nonlocal left
        left -= 1
        if left == 0:
            write(path, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        folder.save(2, {"rows": large(100) + 1, "step": 2})
    monkeypatch.undo()
    assert folder.newest()[1]["step"] == 1
    folder.save(3, {"rows": large(100) + 1, "step": 3})
    assert folder.newest()[1]["step"] == 3
    assert not list(folder.path.glob(".*"))


def test_the_one_before_is_read_where_the_newest_is_damaged(folder: CheckpointFolder) -> None:
    for step in (1, 2):
        folder.save(step, {"step": step, "rows": np.arange(9.0)})
    newest = next(iter(folder))
    content = newest.read_bytes()
    for damaged in (content[:50], content[:-1], b"", content[:-3] + bytes([content[-3] ^ 1]) + content[-2:]):
        newest.write_bytes(damaged)
        assert folder.newest()[1]["step"] == 1
    newest.write_bytes(content)
    assert folder.newest()[1]["step"] == 2


def test_every_flipped_byte_is_noticed(folder: CheckpointFolder) -> None:
    file = folder.save(1, {"step": 1, "rows": large(40)})
    random = np.random.default_rng(0)
    for path in [file, *(folder.path / BLOCKS).iterdir()]:
        content = path.read_bytes()
        for place in random.integers(len(content), size=60):
            path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
            try:
                state = read(file)
            except ValueError as error:
                assert str(error).startswith(str(file))  # noqa: PT017  # some flips change nothing, see below
            else:  # a space of the header's padding, say
                np.testing.assert_array_equal(state["rows"], large(40))
        path.write_bytes(content)


@pytest.mark.parametrize(
    ("shape", "names", "text"),
    [
        ([200_000 << 17], 200_000, "are to be read as 209,7"),
        ([1 << 40], 1, "are too small for an array of shape"),
        ([-1], 1, "negative dimensions"),
        ([1 << 16], 1, "could not broadcast|its blocks have"),
    ],
)
def test_refuses_sizes_beyond_the_blocks_before_memory_is_spent(
    shape: list[int], names: int, text: str, tmp_path: Path
) -> None:
    folder = CheckpointFolder(tmp_path)
    file = folder.save(1, {"rows": np.zeros(1 << 18)})
    (name,) = (path.stem for path in (tmp_path / BLOCKS).iterdir())
    about = {"0": {"shape": shape, "dtype": "<f8", "names": [name] * names}}
    parts = {"state": {"rows": {"$": "array", "array": "0"}}, "blocks": about}
    file.write_bytes(sealed(checkpoint_file.FORMAT, parts, {}))
    tracemalloc.start()
    with pytest.raises(ValueError, match=text):
        read(file)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200 << 20


def test_rows_of_zeros_come_back(tmp_path: Path) -> None:
    """All their blocks are one file."""
    folder = CheckpointFolder(tmp_path)
    folder.save(1, {"rows": np.zeros((40, 1 << 17))})
    assert folder.newest()[1]["rows"].shape == (40, 1 << 17)
    assert len(blocks(folder)) == 1
