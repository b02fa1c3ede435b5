"""Contestants that take turns in one process, so that a machine that slows down slows all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from rich.progress import track

T = TypeVar("T")


def take_turns(
    names: Sequence[str], play: Callable[[str], T], rounds: int, *, description: str = "Turns"
) -> dict[str, list[T]]:
    """What every contestant did in every round; each round another begins.

    Args:
        names: The contestants.
        play: One turn of a contestant.
        rounds: How many.
        description: Beside the progress bar.

    Returns:
        By name, one entry a round.
    """
    played: dict[str, list[T]] = {name: [] for name in names}
    for i in track(range(rounds), description=description):
        first = i % len(names)
        for name in [*names[first:], *names[:first]]:
            played[name].append(play(name))
    return played
