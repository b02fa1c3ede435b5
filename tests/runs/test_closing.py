"""What training says of itself at its end."""

from rich.console import Console

from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.runs.closing import IN_A_ROW, LAST, closing_table


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
