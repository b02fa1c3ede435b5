"""``--compare`` trains twice; where an interrupt comes between, it says how to get the comparison all the same."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from sb3_options import cli
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs.report import CARD
from sb3_options.runs.training import FINISHED
from tests.runs.test_interrupts import command_line, counting, handlers, send

__all__ = ["counting", "handlers"]  # fixtures

BUDGET = 300
"""Primitive steps of each of the two."""

SHORT = ["--compare", "--n-timesteps", str(BUDGET), "--device", "cpu"]


@pytest.fixture(autouse=True)
def program(monkeypatch: pytest.MonkeyPatch) -> None:
    """What commands begin with."""
    monkeypatch.setattr("sys.argv", ["train.py"])


def interrupted(tmp_path: Path, capfd: pytest.CaptureFixture[str], *more: str) -> str:
    """What is printed by training that is interrupted."""
    with pytest.raises(SystemExit) as stopped:
        cli.main(command_line(tmp_path, *SHORT, *more))
    assert stopped.value.code == 130
    return capfd.readouterr().out


def words_of(printed: str, heading: str) -> list[str]:
    """A command that was printed, as a shell takes it, without the program."""
    (line,) = re.findall(rf"^{heading}: +(.+)$", printed, re.MULTILINE)
    words = shlex.split(line, comments=True)
    return words[next(i for i, word in enumerate(words) if Path(word).name == "train.py") + 1 :]


def folders(tmp_path: Path) -> list[Path]:
    return [tmp_path / "dqn" / f"Interrupted-v0_{number}" for number in (1, 2)]


def test_each_of_the_two_folders_is_whole(tmp_path: Path, counting: Any) -> None:
    counting(lambda step: None)
    cli.main(command_line(tmp_path, *SHORT))
    for folder in folders(tmp_path):
        assert all((folder / name).is_file() for name in (runs.MODEL, runs.OPTIONS, CARD, runs.SUBGOALS, FINISHED))
    assert "discover: false" in (folders(tmp_path)[1] / CARD).read_text()


def test_an_interrupt_of_the_second_is_no_comparison(
    tmp_path: Path, counting: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    counting(lambda step: send() if step == BUDGET + 61 else None)
    printed = interrupted(tmp_path, capfd)
    first, second = folders(tmp_path)
    assert f"Finished after {BUDGET} primitive steps" in printed
    assert f"The run without discovery was interrupted after 64 of {BUDGET} primitive steps." in printed
    assert "Both trained" not in printed
    assert "┃ --no-discover ┃" not in printed
    assert (first / FINISHED).is_file()
    assert not (second / FINISHED).exists()
    assert "No discovery:" not in printed
    cli.main([*words_of(printed, "Resume"), "--no-progress"])
    assert (second / FINISHED).is_file()
    compared(words_of(printed, "Then compare"), tmp_path, capfd)


def compared(words: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Whether the command sets the two runs side by side."""
    command, *named = words
    assert command == "compare"
    assert [Path(each).resolve() for each in named] == folders(tmp_path)
    capfd.readouterr()
    cli.main([*words, "--reach", "length=10", "--out", str(tmp_path / "compare.png")])
    assert re.search(r"│ runs +│ 1 +│ 1 +│", capfd.readouterr().out)


@pytest.mark.parametrize("at", ["before its first step", "without checkpoints"])
def test_what_cannot_be_resumed_is_trained_from_its_start(
    at: str, tmp_path: Path, counting: Any, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save, more = configs.save, []

    def interrupt(config: configs.TrainConfig, path: Path) -> None:
        save(config, path)
        if not config.discover:
            monkeypatch.setattr(configs, "save", save)
            send()

    if at == "without checkpoints":
        more = ["--checkpoint-freq", "0"]
    else:
        monkeypatch.setattr(configs, "save", interrupt)
    counting(lambda step: send() if step == BUDGET + 60 and more else None)
    printed = interrupted(tmp_path, capfd, *more)
    first, second = folders(tmp_path)
    steps = 60 if more else 0
    assert f"The run without discovery was interrupted after {steps} of {BUDGET} primitive steps." in printed
    assert "Both trained" not in printed
    assert "Resume:" not in printed
    cli.main(words_of(printed, "No discovery"))
    if more:
        second = second.with_name("Interrupted-v0_3")
    config = configs.load(second / runs.CONFIG)
    assert (config.discover, config.compare, config.n_timesteps) == (False, False, BUDGET)
    *words, beside = words_of(printed, "Then compare")
    assert beside == "FOLDER"
    assert [Path(each).resolve() for each in words[1:]] == [first]
    if not more:
        compared([*words, str(second)], tmp_path, capfd)


def test_resuming_the_first_ends_with_how_to_compare(
    tmp_path: Path, counting: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    counting(lambda step: send() if step == 61 else None)
    printed = interrupted(tmp_path, capfd)
    _, second = folders(tmp_path)
    assert not second.exists()
    cli.main([*words_of(printed, "Resume"), "--no-progress"])
    printed = capfd.readouterr().out
    assert f"Finished after {BUDGET} primitive steps" in printed
    assert "train with --compare" not in printed
    assert not second.exists()
    cli.main(words_of(printed, "No discovery"))
    compared([*words_of(printed, "Then compare")[:-1], str(second)], tmp_path, capfd)


def test_options_that_the_first_began_with_are_not_taken_over(
    tmp_path: Path, counting: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    counting(lambda step: send() if step == BUDGET + 60 else None)
    cli.main(command_line(tmp_path, "--n-timesteps", str(BUDGET), "--checkpoint-freq", "0"))
    options = folders(tmp_path)[0] / runs.OPTIONS
    printed = interrupted(tmp_path, capfd, "--options", str(options))
    cli.main([*words_of(printed, "Resume"), "--no-progress"])
    for said in (printed, capfd.readouterr().out):
        words = words_of(said, "No discovery")
        assert words[words.index("--options") + 1] == "None"
    cli.main(words)
    assert configs.load(folders(tmp_path)[0].with_name("Interrupted-v0_3") / runs.CONFIG).options is None
