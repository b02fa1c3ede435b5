"""``--env-wrapper`` and ``--feature-map`` name a user's code, on the command line and nowhere else."""

from pathlib import Path

import pytest

from sb3_options import OptionBank, cli
from sb3_options.cli import parse
from sb3_options.runs import config as configs
from tests.support.runs import Refused

MODULE = """
import gymnasium as gym
import numpy as np


class Named(gym.ObservationWrapper):
    '''Makes the cell of an xy observation one entry of a Dict.'''

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Dict(
            {"cell": env.observation_space, "clock": gym.spaces.Box(0, np.inf, (1,), np.float32)}
        )
        self.time = 0

    def observation(self, observation):
        self.time += 1
        return {"cell": observation, "clock": np.float32([self.time])}


def cell(observations):
    return np.asarray(observations["cell"], dtype=np.float64)


number = 3


class Bare:
    pass
"""
FLAGS = ["--env-wrapper", "users_module:Named", "--feature-map", "users_module:cell"]


@pytest.fixture(autouse=True)
def users_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "users_module.py").write_text(MODULE)
    (tmp_path / "importing_module.py").write_text("import no_such_package\n")
    monkeypatch.syspath_prepend(tmp_path)


def command_line(tmp_path: Path, *more: str) -> list[str]:
    short = ["--n-timesteps", "300", "--no-progress", "--tensorboard-log", str(tmp_path / "runs"), "--device", "cpu"]
    return ["dqn", *short, "--env-kwargs", "observation:xy", "max_steps:100", *more]


@pytest.mark.parametrize("workers", [[], ["--vec-env", "subproc"]], ids=["here", "subproc"])
def test_a_run_with_both_is_trained_and_evaluated(
    workers: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main(command_line(tmp_path, *FLAGS, "--eval-freq", "200", "--eval-episodes", "1", *workers))
    (run,) = (tmp_path / "runs" / "dqn").iterdir()
    assert "".join(f" {each}" for each in FLAGS) in " ".join(capsys.readouterr().out.split())  # of "Evaluate:"
    config = configs.load(run / "config.yml", {"env_wrapper": "a:b", "feature_map": "c:d"})
    assert (config.env_wrapper, config.feature_map) == ("a:b", "c:d")
    bank = OptionBank(4, 4, feature_size=2)
    bank.load(run / "options.safetensors")
    cli.main(["evaluate", str(run), "--episodes", "2", *FLAGS])
    assert "2 episodes" in capsys.readouterr().out


def test_a_file_that_names_one_is_refused_with_the_flag(tmp_path: Path, refused: Refused) -> None:
    cli.main(command_line(tmp_path, *FLAGS))
    (run,) = (tmp_path / "runs" / "dqn").iterdir()
    for command in (["evaluate", str(run)], ["--config", str(run / "config.yml")]):
        text = refused(*command, codes=[1, 2])
        assert f"{run / 'config.yml'} names the wrapper 'users_module:Named', which would import a module." in text
        assert "If you trust it, pass --env-wrapper users_module:Named." in text
        text = refused(*command, *FLAGS[:2], codes=[1, 2])
        assert "names the feature map 'users_module:cell', which would import a module." in text
    assert parse(["--config", str(run / "config.yml"), *FLAGS]).env_wrapper == "users_module:Named"
    (run / "config.yml").write_text("feature-map: users_module:cell\n")
    assert "names the feature map 'users_module:cell'" in refused("--config", str(run / "config.yml"), codes=[1, 2])


@pytest.mark.parametrize(
    ("flag", "value", "expected"),
    [
        ("--env-wrapper", "users_module", "--env-wrapper takes module:name of a class or function, got 'users_module'"),
        ("--feature-map", "laplacien", "--feature-map takes module:name of a class or function, got 'laplacien'"),
        ("--env-wrapper", "no_such_module:A", "Error: No module named 'no_such_module'"),
        ("--feature-map", "importing_module:a", "Error: No module named 'no_such_package'\n"),
        ("--env-wrapper", "users_module:Bare", "Error: Bare() takes no arguments"),
        ("--feature-map", "users_module:number", "--feature-map takes module:name of"),
    ],
)
def test_what_names_nothing_leaves_no_folder(
    flag: str, value: str, expected: str, tmp_path: Path, refused: Refused
) -> None:
    assert expected in refused(*command_line(tmp_path, flag, value), codes=[1, 2])
    assert not (tmp_path / "runs").exists()
