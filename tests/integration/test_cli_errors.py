"""Errors before a run: environments that are mistyped or cannot be made leave no folder."""

from pathlib import Path

import pytest

from tests.support.runs import Refused


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("sb3_options/TwoRoms-v0", "Did you mean: `TwoRooms`?"),
        ("CartPol-v1", "Did you mean: `CartPole`?"),
        ("Taxi-v9", "Environment version `v9` for environment `Taxi` doesn't exist"),
    ],
)
def test_a_mistyped_environment(wrong: str, said: str, tmp_path: Path, refused: Refused) -> None:
    assert said in refused("--env", wrong, "--tensorboard-log", str(tmp_path / "runs"))
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--env", "Blackjack-v1"], "cannot learn from these observations"),
        (["--device", "abacus"], "device type"),
        (["--env-kwargs", "mapp:1"], "unexpected keyword argument 'mapp'"),
        (["--env", "no_such_module:Env-v0"], "no_such_module"),
    ],
)
def test_an_environment_that_cannot_be_made_leaves_no_folder(
    args: list[str], expected: str, tmp_path: Path, refused: Refused
) -> None:
    assert expected in refused(*args, "--tensorboard-log", str(tmp_path / "runs"))
    assert not (tmp_path / "runs").exists()
