"""Every algorithm, and two in worker processes, cut off wherever something may be half done."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from experiments.kills.states import differing
from sb3_options.callbacks import CheckpointCallback, SubgoalDiscoveryCallback
from sb3_options.checkpoints.file import CheckpointFolder, read
from sb3_options.checkpoints.tree import State
from tests.callbacks.test_checkpoint_resuming import FAST, SLOW, filled, model_of, trained, venv_of
from tests.support.sb3_helpers import fast_callback

STEPS = {"DQN": 6000}
"""Primitive steps after which an algorithm tries an option, where 2,600 are too few: DQN explores empty slots."""


def eager() -> SubgoalDiscoveryCallback:
    """Tries options from the next episode on, so that every algorithm does in these few steps."""
    return fast_callback(max_new_options=2, option_settings={"grow": True})


def first(files: list[Path], holds: Callable[[Path], object]) -> Path:
    return next(file for file in files if holds(file))


def in_episode(file: Path) -> bool:
    states: list[list[State]] = read(file)["environments"][0]["environments"]
    return any(state[-1]["own"]["elapsed"] > 0 for state in states)


def half_written(files: list[Path], folder: Path) -> Path:
    """What a process that was killed in the middle of writing the last checkpoint lets another go on from."""
    folder.mkdir()
    (folder / "blocks").symlink_to(files[0].parent / "blocks")
    *_, before, last = files
    (folder / before.name).write_bytes(before.read_bytes())
    content = last.read_bytes()
    (folder / last.name).write_bytes(content[: len(content) // 2])
    (folder / ".sb3-options-half.safetensors").write_bytes(content[:99])
    file, _ = CheckpointFolder(folder).newest()
    assert file.name == before.name
    return file


@pytest.mark.slow
@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize(
    ("name", "subproc"), [*((name, False) for name in (*FAST, *SLOW)), ("MaskablePPO", True), ("OptionDQN", True)]
)
def test_cut_off_anywhere(name: str, subproc: bool, tmp_path: Path) -> None:
    def make() -> Any:
        return model_of(name, venv_of(subproc=subproc))

    steps = STEPS.get(name, 2600)
    _, whole = trained(make, [eager(), CheckpointCallback(tmp_path / "whole", 1)], steps=steps)
    files = sorted((tmp_path / "whole").glob("0*"))
    after = files.index(first(files, filled))
    cuts = {
        "at the very start": files[0],
        "in warm-up": files[1],  # that of off-policy algorithms is 100 steps long; MacroQ has none
        "inside an episode": first(files, in_episode),
        "right before an option is installed": files[after - 1],
        "right after an option is installed": files[after],
        "while a checkpoint is written": half_written(files, tmp_path / "half"),
    }
    for file in sorted(set(cuts.values())):
        _, resumed = trained(make, [eager(), CheckpointCallback(tmp_path / "rest", 10**9)], resume=file, steps=steps)
        where = [name for name, each in cuts.items() if each == file]
        assert differing(whole, resumed) == [], f"{' and '.join(where)}, after {int(file.stem)} steps"
