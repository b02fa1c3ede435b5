"""A disk that is full while training: what can be written is, what was whole stays, and the user is told in a sentence.

Stands in for the disk: the operating system's limit on the size of a file (RLIMIT_FSIZE).
"""

import errno
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sb3_options import OptionBank
from sb3_options.atomic import atomic_write
from sb3_options.checkpoints.file import CheckpointFolder, read
from sb3_options.runs import folder as runs
from tests.runs.conftest import Register
from tests.support.runs import Refused

resource = pytest.importorskip("resource", reason="limits are of POSIX")

FLAGS = "dqn --env Counted-v0 --no-progress --tensorboard-log"


@pytest.fixture
def limit() -> Iterator[Callable[[int | None], None]]:
    """Sets how large a file may be in bytes; None takes the limit away."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def set_limit(size: int | None) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, before if size is None else (size, before[1]))

    yield set_limit
    set_limit(None)


def test_options_are_saved_where_the_model_cannot_be(
    limit: Any, register: Register, tmp_path: Path, refused: Refused
) -> None:
    register(lambda step: limit(30_000) if step == 60 else None)  # which the logs do not come up to
    error = refused(*FLAGS.split(), str(tmp_path), "--n-timesteps", "90")
    limit(None)
    assert "File too large: '" in error
    assert "model.zip'" in error
    (folder,) = tmp_path.glob("dqn/*")
    assert {path.name for path in folder.iterdir() if path.is_file()} == {runs.CONFIG, runs.OPTIONS}


def test_a_run_that_cannot_begin_leaves_no_folder(limit: Any, register: Any, tmp_path: Path, refused: Refused) -> None:
    register()
    limit(1_000)
    said = refused(*FLAGS.split(), str(tmp_path / "runs"))
    limit(None)
    assert "config.yml'" in said
    assert not list(tmp_path.iterdir())


class Full:
    """A model that can be saved once there are no more checkpoints than ``fits``."""

    def __init__(self, checkpoints: CheckpointFolder, fits: list[int]) -> None:
        self.checkpoints, self.fits = checkpoints, fits

    def save(self, file: Any) -> None:
        there = [int(file.stem) for file in self.checkpoints]
        if not set(there) <= set(self.fits) or (self.checkpoints.path / "blocks" / "rest").exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        file.write(b"the model")


@pytest.mark.parametrize(
    ("there", "fits", "left", "is_saved"),
    [
        ([0, 10, 20], [10, 20], [10, 20], True),
        ([10, 20], [20], [20], True),
        ([10, 20], [], [20], False),
        ([0], [], [], True),
        ([], [0], [], True),
    ],
)
def test_older_checkpoints_make_room_for_the_model(
    there: list[int], fits: list[int], left: list[int], is_saved: bool, tmp_path: Path
) -> None:
    checkpoints = CheckpointFolder(tmp_path / runs.CHECKPOINTS)
    for steps in there:
        checkpoints.save(steps, {"steps": steps})
    if fits == [20]:  # what a checkpoint left that did not fit
        (checkpoints.path / "blocks" / "rest").touch()
    model: Any = Full(checkpoints, fits)
    if is_saved:
        runs.save(model, OptionBank(2, 4), tmp_path)
    else:
        with pytest.raises(OSError, match=r"No space left on device: '.*model\.zip'"):
            runs.save(model, OptionBank(2, 4), tmp_path)
    assert (tmp_path / runs.MODEL).exists() == is_saved
    assert (tmp_path / runs.OPTIONS).exists()
    assert sorted(int(file.stem) for file in checkpoints) == left
    assert all(read(file)["steps"] == int(file.stem) for file in checkpoints)


@pytest.mark.parametrize("size", [0, 1, 1_250, 2_499, 2_500, 5_000])
def test_every_size(size: int, limit: Any, tmp_path: Path) -> None:
    """Whatever fits, a file is the old one or the new one, and the error names it."""
    path, new = tmp_path / "file", bytes(2_500)
    path.write_bytes(b"old")

    def write() -> None:
        limit(size)
        with atomic_write(path) as temporary:
            temporary.write_bytes(new)

    if size < len(new):
        with pytest.raises(OSError, match=f"File too large: '{path}'"):
            write()
    else:
        write()
    assert path.read_bytes() == (b"old" if size < len(new) else new)
    assert list(tmp_path.iterdir()) == [path]
