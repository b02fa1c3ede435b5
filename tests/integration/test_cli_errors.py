"""Errors before a run: environments that are mistyped or cannot be made leave no folder."""

from pathlib import Path

import pytest

from tests.integration.test_cli_run import shell
from tests.support.runs import Refused


class TestErrors:
    @pytest.mark.parametrize(
        ("wrong", "said"),
        [
            ("sb3_options/TwoRoms-v0", "Did you mean: `TwoRooms`?"),
            ("CartPol-v1", "Did you mean: `CartPole`?"),
            ("Taxi-v9", "Environment version `v9` for environment `Taxi` doesn't exist"),
        ],
    )
    def test_a_mistyped_environment(self, wrong: str, said: str, tmp_path: Path, refused: Refused) -> None:
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
        self, args: list[str], expected: str, tmp_path: Path, refused: Refused
    ) -> None:
        assert expected in refused(*args, "--tensorboard-log", str(tmp_path / "runs"))
        assert not (tmp_path / "runs").exists()

    def test_from_the_shell(self, tmp_path: Path) -> None:
        done = shell("--env", "sb3_options/TwoRoms-v0", cwd=tmp_path)
        assert done.returncode == 1
        assert "TwoRooms" in done.stderr
        assert "Traceback" not in done.stderr + done.stdout
