"""The record of what ran, as it is written into an info and read from it."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest

from sb3_options.experience.option_run import OptionRun

PRIMITIVE = OptionRun(-1, 1, 0.9, 0.9, "primitive")
STEPS = np.arange(3.0)[:, None], np.array([1, 0, 1]), np.zeros(3), np.ones((3, 4), dtype=bool)
OPTION = OptionRun(2, 3, 0.9**3, 0.9, "subgoal", *STEPS, True)


@pytest.mark.parametrize("run", [PRIMITIVE, OPTION, OPTION._replace(available=None)])
@pytest.mark.parametrize("travels", [lambda info: info, copy.deepcopy, lambda info: pickle.loads(pickle.dumps(info))])
def test_what_was_written_is_read(run: OptionRun, travels: Any) -> None:
    read = OptionRun.from_info(travels({"option": run.as_info()}))
    assert type(read) is OptionRun
    for field, expected in zip(read, run, strict=True):
        np.testing.assert_array_equal(field, expected)


def test_a_users_own_environment_need_only_say_duration_and_discount() -> None:
    run = OptionRun.from_info({"option": {"duration": 4, "discount": 0.9**4}})
    assert (run.index, run.duration, run.discount, run.termination) == (-1, 4, 0.9**4, "primitive")
    assert OptionRun.from_info({"option": {"duration": np.array(3), "discount": np.array([0.5])}})[1:3] == (3, 0.5)
    assert run.gamma == pytest.approx(0.9, rel=1e-15)
    assert run[5:] == (None,) * 6


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({}, r'^There is no info\["option"\]: wrap the environment in OptionsWrapper, or, .+"discount": gamma\*\*k}\.'),
        ({"option": "left"}, r'^info\["option"\] must be a dict with a positive "duration" .+ got \'left\': let '),
        ({"option": {"index": 3}}, r"got \{'index': 3\}: let the environment's step leave"),
        ({"option": {"duration": 0, "discount": 0.9}}, "got {'duration': 0"),
        ({"option": {"duration": 2, "discount": 1.1}}, "'discount': 1.1}"),
        ({"option": {"duration": "2", "discount": 0.9}}, "got {'duration': '2'"),
        ({"option": {"duration": 1, "discount": float("nan")}}, "'discount': nan}"),
        ({"option": {"index": -1, "duration": -1, "discount": 0.9}}, "'duration': -1"),
    ],
)
def test_anything_else_is_refused(info: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        OptionRun.from_info(info)
