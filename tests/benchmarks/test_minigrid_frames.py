"""The benchmark of MiniGrid's frames, small."""

from concurrent.futures import ThreadPoolExecutor
from threading import Semaphore
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import minigrid_frames
from benchmarks.minigrid_frames import Turns
from experiments.minigrid import settings


def test_one_trains_while_the_other_waits() -> None:
    first, second = Semaphore(1), Semaphore(0)
    order: list[str] = []

    def train(name: str, turns: Turns) -> None:
        for rollout in range(4):
            model: Any = SimpleNamespace(num_timesteps=10 * rollout)
            turns.model = model
            turns._on_rollout_start()
            order.append(f"{name} {rollout}")
        turns.other.release(9)

    turns = Turns(first, second), Turns(second, first)
    with ThreadPoolExecutor(2) as threads:
        for done in [threads.submit(train, *of) for of in zip("ab", turns, strict=True)]:
            done.result()
    assert order == [f"{name} {rollout}" for rollout in range(4) for name in "ab"]
    assert all(len(each.costs()) == 2 for each in turns)  # without the first


@pytest.mark.slow
def test_both_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = settings.FAMILIES["MultiRoom-4"]
    monkeypatch.setitem(settings.FAMILIES, "MultiRoom-4", tuple(each._replace(frames=2_048) for each in rooms))
    found = minigrid_frames.race("MultiRoom-4", 10_000, 0)
    assert found["n_turns"] >= 2
    assert 0.2 < found["mean"] < 5
    assert found["frames_per_decision"] >= 1
