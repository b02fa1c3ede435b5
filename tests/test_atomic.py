import errno
import os
import time
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from sb3_options.atomic import PREFIX, STALE, atomic_write, remove_stale


def test_writes_makes_folders_and_replaces(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "file.txt"
    for text in ("first", "second, longer"):
        with atomic_write(path) as temporary:
            assert temporary.parent == path.parent
            assert temporary.suffix == ".txt"
            temporary.write_text(text)
            assert not path.exists() or path.read_text() == "first"
        assert path.read_text() == text
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("old", [b"old", None])
def test_an_error_while_writing_leaves_the_old_file(tmp_path: Path, old: bytes | None, error: Any) -> None:
    path = tmp_path / "file"
    if old is not None:
        path.write_bytes(old)

    def write() -> None:
        with atomic_write(str(path)) as temporary:
            temporary.write_bytes(b"half of the n")
            raise error("while writing")

    with pytest.raises(error, match="while writing"):
        write()
    assert [p.read_bytes() for p in tmp_path.iterdir()] == ([] if old is None else [old])


@pytest.mark.parametrize(("owner", "name"), [(os, "fsync"), (Path, "replace"), (Path, "chmod")])
def test_a_full_disk_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str
) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def write() -> None:
        with atomic_write(path) as temporary:
            temporary.write_bytes(b"new")

    monkeypatch.setattr(owner, name, MagicMock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(OSError, match=f"No space left on device: '{path}'"):
        write()
    monkeypatch.undo()
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]
    write()
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"new"]


def test_everything_is_on_the_disk_before_it_replaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def recorded_fsync(descriptor: int) -> None:
        calls.append(f"fsync {os.fstat(descriptor).st_size}")
        fsync(descriptor)

    def recorded_replace(self: Path, target: Path) -> Path:
        calls.append("replace")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", recorded_fsync)
    monkeypatch.setattr(Path, "replace", recorded_replace)
    with atomic_write(tmp_path / "file") as temporary:
        temporary.write_bytes(b"12345")
    assert calls == ["fsync 5", "replace"]


def test_what_killed_processes_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    names = [f"{PREFIX}old.zip", f"{PREFIX}new.zip", ".others.zip", f"run/{PREFIX}old.zip"]
    for name in names:
        (tmp_path / name).touch()
        if "new" not in name:
            os.utime(tmp_path / name, (0, time.time() - STALE - 1))
    with atomic_write(tmp_path / "file") as temporary:
        temporary.write_bytes(b"")
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {"file", *names[1:]}
    remove_stale(tmp_path, "*/")
    assert not (tmp_path / names[3]).exists()
