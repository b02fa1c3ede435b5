"""``train.py --series``: options of one task are there in the next."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sb3_contrib import MaskablePPO

from sb3_options import cli
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.options.bank import OptionBank
from sb3_options.runs import config as configs
from sb3_options.runs.closing import IN_A_ROW
from sb3_options.runs.flags import parse
from sb3_options.runs.task_ends import KEPT, StopWhenLearned, free_slots
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
    history = [EpisodeRecord(1, 1.0, True, 1)] * (IN_A_ROW - 1)
    stop = StopWhenLearned(history)
    assert stop._on_step()
    history += [EpisodeRecord(2, 0.0, False, 1), *[EpisodeRecord(3, 1.0, True, 1)] * (IN_A_ROW - 1)]
    assert stop._on_step()
    history.append(EpisodeRecord(4, 1.0, True, 1))
    assert not stop._on_step()


def test_options_that_no_success_needs_leave_their_slots() -> None:
    env = optioned_rooms()
    callback = fast_callback()
    assert free_slots(None, OptionBank(4, 4)) == []  # before training
    MaskablePPO("MlpPolicy", env, gamma=0.9, n_steps=128, seed=0, device="cpu").learn(6_000, callback=callback)
    (needed,) = callback.bank.filled
    option: Any = callback.bank[needed]
    bank = callback.bank.copy()
    assert free_slots(callback.discovery, bank) == []  # every way leads through the doorway
    bank.remove(needed)
    corner = replace(option.subgoal, points=option.subgoal.points * 0.0)
    bank.add(option.with_regions(corner, option.initiation_set))
    assert free_slots(callback.discovery, bank) == [option.name]
    assert len(bank) == 0


def test_a_mistake_in_a_later_task_is_found_before_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for wrong, message in (("goal:[20, 9]", "outside the map"), ("gaol:[3, 3]", "gaol")):
        with pytest.raises(SystemExit):
            cli.main(command_line(tmp_path, "--series", "goal:[8, 4]", wrong))
        text = " ".join(capsys.readouterr().err.split())
        assert message in text
        assert "This is task 2 of the series." in text
    assert not (tmp_path / "runs").exists()


def test_a_series_that_ends_early_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(command_line(tmp_path, "--series", "goal:[8, 4]", "goal:[8, 0]", "--n-timesteps", "256"))
    out = " ".join(capsys.readouterr().out.split())
    assert "Of 2 tasks 1 were not begun." in out
    assert "--compare" not in out


def test_an_interrupt_at_the_start_of_a_task_keeps_what_was_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    done = cli._train

    def second_is_interrupted(config: Any, **kwargs: Any) -> Any:
        if config.options is not None:
            raise KeyboardInterrupt("before the first step: there is nothing to keep")
        return done(config, **kwargs)

    monkeypatch.setattr(cli, "_train", second_is_interrupted)
    with pytest.raises(SystemExit) as stopped:
        cli.main(command_line(tmp_path, "--series", "goal:[1, 1]", "goal:[8, 0]", "--n-timesteps", "5000"))
    assert stopped.value.code == 130
    out = " ".join(capsys.readouterr().out.split())
    (folder,) = (tmp_path / "runs" / "maskableppo").iterdir()
    assert folder.name in out.partition("Run folders:")[2]
    assert "Of 2 tasks 1 were not begun." in out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('series: "goal:[10,5]"', "series takes a list of tasks"),
        ("series: 5", "series takes a list of tasks"),
        ("series: [foo]", "--series takes pairs name:value"),
    ],
)
def test_a_file_with_no_series_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "settings.yml").write_text(f"algo: ppo\n{text}\n")
    with pytest.raises(SystemExit) as stopped:
        parse(["--config", str(tmp_path / "settings.yml")])
    assert message in str(stopped.value.code)


def test_a_series_is_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(command_line(tmp_path, "--series", "goal:[8, 4]", "--compare"))
    assert "--compare is for one task" in " ".join(capsys.readouterr().err.split())
