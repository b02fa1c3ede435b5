"""``train.py --series``: options of one task are there in the next."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sb3_contrib import MaskablePPO

from sb3_options import cli
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.options.bank import OptionBank
from sb3_options.runs import config as configs
from sb3_options.runs.closing import IN_A_ROW
from sb3_options.runs.flags import parse
from sb3_options.runs.series import KEPT, StopWhenLearned, free_slots
from tests.support.sb3_helpers import SMALL_ROOMS, fast_callback, optioned_rooms


def command_line(tmp_path: Path, *more: str) -> list[str]:
    common = ["--no-progress", "--device", "cpu", "--tensorboard-log", str(tmp_path / "runs")]
    env = ["--env-kwargs", f"map:{json.dumps(SMALL_ROOMS)}", "observation:xy", "max_steps:150"]
    discovery = ["--discovery.min-positive", "3", "--discovery.start-radius", "0.5", "--discovery.decay", "0.5"]
    return ["maskableppo", *common, *env, *discovery, "--n-steps", "128", *more]


def test_each_task_is_a_pair_or_a_mapping() -> None:
    config = parse(["ppo", "--series", "goal:[4, 2]", "{goal: [8, 4], max_steps: 9}"])
    assert config.series == ({"goal": [4, 2]}, {"goal": [8, 4], "max_steps": 9})
    with pytest.raises(SystemExit):
        parse(["ppo", "--series", "{goal: [4, 2"])


def test_options_of_one_task_are_there_in_the_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = ["--series", "goal:[8, 4]", "goal:[8, 0]"]
    cli.main(command_line(tmp_path, *tasks, "--n-timesteps", "12000", "--learning-rate", "0.002"))
    out = " ".join(capsys.readouterr().out.split())
    first, second = sorted((tmp_path / "runs" / "maskableppo").iterdir(), key=lambda run: run.stat().st_ctime)
    own = [configs.load(run / "config.yml") for run in (first, second)]
    assert [config.env_kwargs["goal"] for config in own] == [[8, 4], [8, 0]]
    assert own[1].n_timesteps < own[0].n_timesteps == 12_000
    assert own[1].options == first / KEPT
    bank = OptionBank(4, 4, feature_size=2)
    bank.load(first / KEPT)
    kept = [option.name for option in bank.slots if option is not None]
    assert kept
    assert "Task 2 of 2" in out
    assert f"Started with the options of {first / KEPT}" in out
    assert (second / "model.zip").is_file()


def test_a_task_is_learned_after_so_many_successes_in_a_row() -> None:
    discovery: Any = SimpleNamespace(history=[EpisodeRecord(1, 1.0, True, 1)] * (IN_A_ROW - 1))
    stop = StopWhenLearned(discovery)
    assert stop._on_step()
    discovery.history += [EpisodeRecord(2, 0.0, False, 1), *[EpisodeRecord(3, 1.0, True, 1)] * (IN_A_ROW - 1)]
    assert stop._on_step()
    discovery.history.append(EpisodeRecord(4, 1.0, True, 1))
    assert not stop._on_step()


def test_options_that_no_success_needs_leave_their_slots() -> None:
    env = optioned_rooms()
    callback = fast_callback()
    assert free_slots(callback) == []  # before training
    MaskablePPO("MlpPolicy", env, gamma=0.9, n_steps=128, seed=0, device="cpu").learn(6_000, callback=callback)
    (needed,) = callback.bank.filled
    option: Any = callback.bank[needed]
    assert free_slots(callback) == []  # every way leads through the doorway
    elsewhere: Any = callback.bank.remove(needed)
    object.__setattr__(elsewhere.subgoal, "points", elsewhere.subgoal.points * 0.0)
    callback.bank.add(elsewhere)
    assert free_slots(callback) == [option.name]
    assert len(callback.bank) == 0


def test_a_series_is_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(command_line(tmp_path, "--series", "goal:[8, 4]", "--compare"))
    assert "--compare is for one task" in " ".join(capsys.readouterr().err.split())
