"""Training by `cli.main` in this process: algorithms, flags, what it prints, and an interrupt."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_options import OptionBank, cli
from sb3_options.cli import parse
from sb3_options.discovery.figures import subgoals_figure
from sb3_options.runs import config as configs
from sb3_options.runs import training
from sb3_options.runs.config import ALGORITHMS
from tests.support.runs import train


class TestTrain:
    @pytest.mark.parametrize(
        ("args", "text"),
        [
            (["--n-timesteps", "30"], "No subgoal was discovered: no episode has ended. Train for longer"),
            (["--algo", "dqn", "--env", "CliffWalking-v1"], "No subgoal was discovered: no success in"),
            (["--max-new-options", "0"], "Discovery was switched off."),
            (["--max-options", "0"], "There was no free slot for an option"),
        ],
    )
    def test_says_why_there_is_no_option_as_the_picture_does(
        self, args: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:  # fmt: skip
        drawn: list[str] = []

        def draw(discovery: Any, bank: OptionBank, text: str) -> Figure:
            drawn.append(text)
            return subgoals_figure(discovery, bank, text)

        monkeypatch.setattr(training, "subgoals_figure", draw)
        cli.main(["--n-timesteps", "1500", "--no-progress", "--tensorboard-log", str(tmp_path), *args])
        printed = capsys.readouterr().out
        assert text in drawn[0]
        assert f"{drawn[0]}\n" in printed

    @pytest.mark.parametrize("algo", [name for name in ALGORITHMS if name != "dqn"])
    @pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")  # 2 environments, not 8
    def test_other_algorithms_and_several_environments(self, algo: str, tmp_path: Path) -> None:
        args = ["--algo", algo, "--n-envs", "2", "--n-timesteps", "400", "--tensorboard-log", str(tmp_path)]
        args += ["--no-progress", "--max-new-options", "0", "--eval-freq", "200", "--eval-episodes", "1"]
        args += ["--learning-starts", "300"] if "dqn" in algo else ["--n-steps", "64"]
        args += ["--n-epochs", "1"] if "ppo" in algo else []
        cli.main([*args, "--env-kwargs", "max_steps:30"])
        folder = tmp_path / algo / "sb3_options-TwoRooms-v0_1"
        assert (folder / "model.zip").is_file()
        assert len(list((folder / "monitor").iterdir())) == 2
        assert len(np.load(folder / "evaluations.npz")["timesteps"]) >= 1
        cli.main(["evaluate", str(folder), "--episodes", "1"])

    def test_says_how_it_went(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        args = ["--n-timesteps", "2000", "--no-progress", "--tensorboard-log", str(tmp_path)]
        cli.main([*args, "--env-kwargs", "max_steps:100"])
        printed = capsys.readouterr().out
        assert re.search(r"│ success rate, at the end +│ [01]", printed)
        assert len(list((tmp_path / "maskableppo").glob("*_1/monitor/*"))) == 8


def test_an_intrinsic_reward(tmp_path: Path) -> None:
    args = ["maskableppo", "--bonus", "counts", "--n-timesteps", "1500", "--max-options", "1", "--no-progress"]
    folder = train(parse([*args, "--env-kwargs", "max_steps:100", "--tensorboard-log", str(tmp_path)]))
    assert configs.load(folder / "config.yml").bonus == "counts"
    (events,) = folder.rglob("events*")
    scalars = EventAccumulator(str(events))
    scalars.Reload()
    assert scalars.Scalars("intrinsic/bonus")[-1].value > 0
