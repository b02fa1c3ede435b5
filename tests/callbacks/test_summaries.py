"""Results beside settings, and what is said of an option."""

from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.logger import configure

from sb3_options.callbacks.summaries import log_results, steps_to_learn
from sb3_options.experience.trajectories import EpisodeRecord


def history_of(successes: list[bool]) -> list[EpisodeRecord]:
    """Episodes of 10 steps, each with a return of its number."""
    return [EpisodeRecord(10 * (i + 1), float(i), success, 10) for i, success in enumerate(successes)]


@pytest.mark.parametrize(
    ("successes", "steps"),
    [
        ([True] * 100, None),  # one rate, and two in a row are needed
        ([True] * 101, 1000),
        ([True] * 89 + [False] * 500, None),
        ([False] * 30 + [True] * 200, 1200),  # after 30 failures and 90 successes
        ([True, False] * 100, None),
        ([], None),
    ],
)
def test_steps_until_ninety_of_the_last_hundred_succeeded(successes: list[bool], steps: int | None) -> None:
    assert steps_to_learn(history_of(successes)) == steps


def test_results_are_of_the_last_hundred_episodes_beside_flat_settings(tmp_path: Path) -> None:
    log = configure(str(tmp_path), ["tensorboard"])
    nested = {"a": 1, "b": {"c": True, "d": {"e": 2.5}}, "layers": (64, 32), "none": None, "name": "x"}
    log_results(log, nested, history_of([True] * 100 + [False] * 50), 1500)
    told: dict[str, Any] = log.name_to_value
    assert (told["at_end/success_rate"], told["at_end/return"], told["at_end/steps_to_90_percent"]) == (0.5, 99.5, 1000)
    assert told["settings"].hparam_dict == {"a": 1, "b.c": "True", "b.d.e": 2.5, "layers": "(64, 32)", "name": "x"}
    log.dump(1500)
