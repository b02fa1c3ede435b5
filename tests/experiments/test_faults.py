from pathlib import Path

import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from experiments.faults import checkpoints, files, fuzz, memory
from sb3_options.checkpoints import file as checkpoint_file
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.options.bank import OptionBank


def test_options_files_are_refused_whatever_is_damaged(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "options.safetensors"
    OptionBank(4, 4).save(path)
    assert all(set(row) == {"refused"} for row in files.check(path, files.options_in, 200, rng).values())


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


def test_fuzzed_bags_and_settings() -> None:
    for found, n in ((fuzz.check_bags(8, 0), 16), (fuzz.check_settings(30, 0), 30)):
        assert sum(sum(of.values()) for of in found.values()) == n
        assert {name for of in found.values() for name in of} == {"result", "refused"}
