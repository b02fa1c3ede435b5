import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from experiments.faults import checkpoints, disk, files, fuzz, memory, workers
from sb3_options.atomic import atomic_write
from sb3_options.checkpoints import file as checkpoint_file
from sb3_options.checkpoints.file import CheckpointFolder
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


def test_no_damaged_checkpoint_is_read_wrongly(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_file, "BLOCK_BYTES", 1 << 10)
    folder = CheckpointFolder(tmp_path / "checkpoints")
    rows = np.arange(600.0)
    for step in (1, 2):
        folder.save(step, {"rows": rows, "few": np.arange(step), "step": step})
        rows = rows + (np.arange(600) > 300)  # the first blocks are shared
    found = checkpoints.check(folder.path, 120, rng)
    assert {what: sum(of.values()) for what, of in found.items()} == {"file": 60, "block": 60}
    assert not {name for of in found.values() for name in of} & {"wrong", "error"}
    assert found["file"]["passed over"] > 50
    assert found["block"]["refused"] > 5
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoints"]


def test_a_checkpoint_that_is_not_checked_is_read_wrongly(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = CheckpointFolder(tmp_path / "checkpoints")
    for step in (1, 2):
        folder.save(step, {"rows": np.arange(600.0) + step})
    (folder.path / "blocks" / "a").write_bytes(bytes(99))
    (folder.path / "blocks" / "b").write_bytes(bytes(99))
    monkeypatch.setattr(checkpoint_file, "_digest", lambda *_: "the same for all")
    for step in (3, 4):
        folder.save(step, {"rows": np.arange(600.0) + step})
    for name in "ab":
        (folder.path / "blocks" / name).write_bytes(bytes(range(99)))
    assert checkpoints.check(folder.path, 60, rng)["file"]["wrong"] > 0


def _raise(error: Exception) -> fuzz.Found:
    raise error


@pytest.mark.parametrize(
    ("compute", "outcome"),
    [
        (lambda: [np.array([1.0, -np.inf])], "result"),
        (lambda: [np.ones(2), np.array([np.nan])], "not a number"),
        (lambda: [np.array([np.inf])], "not a number"),
        (lambda: _raise(ValueError()), "refused"),
        (lambda: np.zeros(2).reshape(7), "refused"),
        (lambda: json.loads("{"), "another's error"),
        (lambda: _raise(ZeroDivisionError()), "error"),
    ],
)
def test_what_a_computation_ends_in(compute: Callable[[], fuzz.Found], outcome: str) -> None:
    assert fuzz.outcome(compute) == outcome


def test_fuzzed_bags_and_settings() -> None:
    for found, n in ((fuzz.check_bags(25, 0), 50), (fuzz.check_settings(30, 0), 30)):
        assert sum(sum(of.values()) for of in found.values()) == n
        assert {name for of in found.values() for name in of} == {"result", "refused"}


@pytest.mark.slow
def test_workers_that_are_killed(tmp_path: Path) -> None:
    found = workers.run(tmp_path / "out", 8_192, 2.0, seed=0, n_workers=2)
    assert found["ended"] == {"one line": found["times_killed"], "otherwise": 0, "hanging": 0}
    assert found["times_killed"] > 0
    assert found["orphans"] == found["checkpoints_lost"] == 0
    assert not any(found["differences"].values())
