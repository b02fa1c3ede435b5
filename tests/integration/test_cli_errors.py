"""Errors before a run: environments that are mistyped or cannot be made leave no folder."""

from pathlib import Path

import pytest

from tests.integration.test_cli_run import Stopping, shell
from tests.support.sb3_helpers import TAXI


class TestErrors(Stopping):
    @pytest.mark.parametrize(
        ("wrong", "right"),
        [
            ("sb3_options/TwoRoms-v0", "sb3_options/TwoRooms-v0"),
            ("TwoRooms-v0", "sb3_options/TwoRooms-v0"),
            ("CartPol-v1", "CartPole-v1"),
            ("Taxi-v9", TAXI),
        ],
    )
    def test_a_mistyped_environment(
        self, wrong: str, right: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = self.stopped(capsys, "--env", wrong, "--tensorboard-log", str(tmp_path / "runs"))
        assert f"There is no environment {wrong!r}. Did you mean {right!r}?" in text
        assert not (tmp_path / "runs").exists()

    @pytest.mark.parametrize(
        ("args", "expected"),
        [
            (
                ["--env", "Blackjack-v1"],
                "observation space is not supported",
            ),
            (["--env-kwargs", "mapp:1"], "unexpected keyword argument 'mapp'"),
            (["--env", "no_such_module:Env-v0"], "no_such_module"),
        ],
    )
    def test_an_environment_that_cannot_be_made_leaves_no_folder(
        self, args: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert expected in self.stopped(capsys, *args, "--tensorboard-log", str(tmp_path / "runs"))
        assert not (tmp_path / "runs").exists()

    def test_from_the_shell(self, tmp_path: Path) -> None:
        done = shell("--env", "sb3_options/TwoRoms-v0", cwd=tmp_path)
        assert done.returncode == 1
        assert "Did you mean 'sb3_options/TwoRooms-v0'?" in done.stderr
        assert "Traceback" not in done.stderr + done.stdout
