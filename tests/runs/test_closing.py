"""What training says of itself at its end."""

import shlex
from pathlib import Path

import pytest
from rich.console import Console

from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.runs.closing import IN_A_ROW, LAST, closing_table, next_commands
from sb3_options.runs.config import PPOConfig


def rows(*histories: list[EpisodeRecord]) -> dict[str, list[str]]:
    console = Console(width=120, no_color=True)
    with console.capture() as captured:
        console.print(closing_table({str(i): history for i, history in enumerate(histories)}))
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in captured.get().splitlines() if "│" in line]
    return {name: values for name, *values in cells}


def episodes(outcomes: list[bool], steps: int = 10) -> list[EpisodeRecord]:
    return [EpisodeRecord(steps * (i + 1), float(good), good, steps) for i, good in enumerate(outcomes)]


def test_the_last_episodes_apart_from_all() -> None:
    history = episodes([False] * LAST, 50) + episodes([True] * LAST, 10)
    shown = rows(history, [])
    assert shown["success rate, last 100 episodes"] == ["1", "–"]
    assert shown["success rate, all episodes"] == ["0.5", "–"]
    assert shown["return, all episodes"] == ["0.5", "–"]
    assert shown["primitive steps, last 100 episodes"] == ["10", "–"]
    assert shown["primitive steps, all episodes"] == ["30", "–"]
    assert shown["episodes"] == ["200", "0"]


def test_when_the_task_was_learned() -> None:
    almost = [True] * (IN_A_ROW - 1)
    shown = rows(episodes([*almost, False, *almost, True]), episodes([*almost, False, *almost]))
    assert shown["20 successes in a row after"] == ["400 steps", "–"]


@pytest.mark.parametrize(
    ("program", "seen_from", "shown"),
    [
        ("train.py", "checkout", "train.py"),
        ("../checkout/train.py", "else where", "../checkout/train.py"),
        ("{root}/else where/train.py", "checkout", "'../else where/train.py'"),
        ("{root}/checkout/pytest", "checkout", "train.py"),
        ("{root}/bin/sb3-options", "checkout", "../bin/sb3-options"),
        ("{root}/site/sb3_options/__main__.py", "checkout", "-m sb3_options"),
    ],
)
def test_the_next_command_finds_the_program(
    program: str, seen_from: str, shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / seen_from).mkdir()
    monkeypatch.chdir(tmp_path / seen_from)
    monkeypatch.setattr("sys.argv", [program.format(root=tmp_path)])
    console = Console(width=400, no_color=True)
    with console.capture() as captured:
        next_commands(console, PPOConfig(), Path("runs/ppo"))
    assert f" {shown} evaluate runs/ppo --video " in captured.get()


def commands(folder: Path, *, draws: bool = True) -> dict[str, list[str]]:
    """The words of what is printed, as a shell takes them, by its heading."""
    console = Console(width=400, no_color=True)
    with console.capture() as captured:
        next_commands(console, PPOConfig(), folder, draws=draws)
    lines = [line.partition(":") for line in captured.get().splitlines()]
    return {name: shlex.split(rest) for name, _, rest in lines}


def test_the_next_commands_can_be_pasted_where_a_path_has_a_space(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/my python/bin/python9")
    shown = commands(Path("my runs/ppo"))
    assert shown["TensorBoard"] == ["/my python/bin/python9", "-m", "tensorboard.main", "--logdir", "my runs/ppo"]
    assert shown["Evaluate"][0] == "/my python/bin/python9"
    assert shown["Evaluate"][-4:] == ["evaluate", "my runs/ppo", "--video", "my runs/ppo/video.mp4"]


def test_no_video_is_proposed_of_an_environment_that_draws_nothing() -> None:
    assert commands(Path("runs/ppo"), draws=False)["Evaluate"][-2:] == ["evaluate", "runs/ppo"]
