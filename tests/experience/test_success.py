from typing import Any

import numpy as np
import pytest

from sb3_options.experience.success import judged, reported_success, success_in, success_rule
from sb3_options.experience.trajectories import Trajectory
from tests.support.helpers import trajectory_of


def episode(rewards: list[float], *, terminated: bool = True, is_success: bool | None = None) -> Trajectory:
    return trajectory_of(range(len(rewards) + 1), rewards=rewards, terminated=terminated, is_success=is_success)


@pytest.mark.parametrize(
    ("trajectory", "success"),
    [
        (episode([-1.0], is_success=True), True),
        (episode([1.0], is_success=False), False),
        (episode([0.0, 1.0]), True),
        (episode([1.0, 0.0]), False),
        (episode([0.0, -1.0]), False),
        (episode([0.0, 1.0], terminated=False), False),
        (episode([0.0, 1.0], terminated=False, is_success=True), True),
        (episode([], terminated=False), False),
        (episode([]), False),
        (episode([1.0, 1.0]), False),
    ],
)
def test_reported_success(trajectory: Trajectory, success: bool) -> None:
    assert reported_success(trajectory) is success


@pytest.mark.parametrize("said", [True, 1, 1.0, np.True_, np.float32(1), np.array(1.0), np.array([True]), np.int64(1)])
def test_what_an_info_says(said: Any) -> None:
    assert success_in({"is_success": said}) is True
    assert success_in({"is_success": 1 - np.asarray(said, dtype=float)}) is False
    assert success_in({"is_success": None}) is None
    assert success_in({}) is None


@pytest.mark.parametrize(
    "said", [float("nan"), np.nan, "no", "False", 0.5, 2, -1, [], [True, False], np.array([]), {}, b"1", object()]
)
def test_an_info_that_says_neither(said: Any) -> None:
    with pytest.raises(ValueError, match=r'info\["is_success"\] must be True or False \(or 1 or 0\), got .+'):
        success_in({"is_success": said})


@pytest.mark.parametrize(
    ("text", "successes"),
    [
        ("reported", [True, False, False]),
        ("terminated", [True, True, False]),
        ("return:2", [False, True, False]),
        ("return:-1", [True, True, True]),
        ("steps:1", [True, False, False]),
    ],
)
def test_a_text_names_a_rule(text: str, successes: list[bool]) -> None:
    episodes = [episode([1.0]), episode([3.0, -1.0]), episode([0.0, 0.0], terminated=False)]
    assert list(map(success_rule(text), episodes)) == successes


@pytest.mark.parametrize(
    "text", ["", "return", "return:", "return:nan", "return:x", "steps:0", "steps:1.5", "terminal"]
)
def test_a_text_that_names_none(text: str) -> None:
    with pytest.raises(ValueError, match=rf"for instance return:30, got {text!r}; in a script also a function of a Tr"):
        success_rule(text)


@pytest.mark.parametrize("said", ["no", np.array([True, False]), []])
def test_what_a_rule_may_not_say(said: Any) -> None:
    with pytest.raises(TypeError, match=r"^success must return True or False, got "):
        judged(lambda _: said, episode([1.0]))
