from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from experiments.faults import disk, files, memory
from sb3_options.atomic import atomic_write
from sb3_options.options.bank import OptionBank


def _trusting(path: Path) -> bytes:
    return path.read_bytes()


def _checked(path: Path) -> bytes:
    content = path.read_bytes()
    if content[:-1] != bytes(range(200)) or content[-1] > 9:
        raise ValueError(f"{path} is damaged.")
    return content[:-1]


def _silent(path: Path) -> bytes:
    if path.read_bytes() != bytes(range(200)):
        raise ValueError("something is wrong")
    return b""


@pytest.mark.parametrize(("read", "outcome"), [(_trusting, "wrong"), (_checked, "refused"), (_silent, "error")])
def test_what_becomes_of_a_damaged_file(
    tmp_path: Path, read: Callable[[Path], bytes], outcome: str, rng: np.random.Generator
) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(range(200)) + (b"\0" if read is _checked else b""))
    counts = files.check(path, read, 60, rng)
    assert sum(sum(row.values()) for row in counts.values()) == 60
    assert len(counts) == 6
    harmless = {"unharmed"} if read is _checked else set()
    assert {name for row in counts.values() for name in row} <= {outcome} | harmless


def test_options_files_are_refused_whatever_is_damaged(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "options.safetensors"
    OptionBank(4, 4).save(path)
    assert all(set(row) == {"refused"} for row in files.check(path, files.options_in, 200, rng).values())


def test_a_file_is_kept_only_if_it_is_replaced_whole() -> None:
    def in_place(path: Path) -> None:
        path.write_bytes(bytes(100))

    def atomic(path: Path) -> None:
        with atomic_write(path) as temporary:
            temporary.write_bytes(bytes(100))

    def beside(path: Path) -> None:
        path.touch()
        try:
            path.with_name("other").write_bytes(bytes(100))
            path.write_bytes(bytes(100))
        except OSError:
            pass

    assert disk.overwrite("file", atomic, 7) == {"kept": 7, "lost": 0, "silent": 0}
    assert disk.overwrite("file", in_place, 7) == {"kept": 0, "lost": 7, "silent": 0}
    assert disk.overwrite("file", beside, 7) == {"kept": 0, "lost": 0, "silent": 7}


@pytest.mark.parametrize("name", memory.CASES)
def test_long_runs_run(name: str) -> None:
    result = memory.run(name, 600, 120, seed=0)
    assert result["after_warm_up"] > 0
    assert result["growth"] == result["at_end"] - result["after_warm_up"]
