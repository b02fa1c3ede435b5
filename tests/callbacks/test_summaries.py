"""Results beside settings, and what is said of an option."""

import pytest

from sb3_options.callbacks.summaries import flat_settings, results_of, steps_to_learn
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


def test_results_are_of_the_last_hundred_and_what_never_came_is_left_out() -> None:
    assert results_of([]) == {}
    assert results_of(history_of([True] * 50)) == {"at_end/success_rate": 1.0, "at_end/return": 24.5}
    assert results_of(history_of([True] * 100 + [False] * 50)) == {
        "at_end/success_rate": 0.5,
        "at_end/return": 99.5,
        "at_end/steps_to_90_percent": 1000,
    }


def test_settings_are_flat_and_of_one_kind_each() -> None:
    nested = {"a": 1, "b": {"c": True, "d": {"e": 2.5}}, "layers": (64, 32), "none": None, "code": print, "name": "x"}
    assert flat_settings(nested) == {"a": 1, "b.c": "True", "b.d.e": 2.5, "layers": "64, 32", "name": "x"}
