from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_options.callbacks.reliability import MIN_PASSES, MIN_RUNS, RUNS_BETWEEN, WINDOW, Reliability
from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray, Observations
from sb3_options.experience.option_run import OptionRun
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import TabularPolicy

FINE, CIRCLE, FAR = 1.0, 2.0, 3.0
"""Places on a line; the subgoal is at 0."""


def places(observations: Observations) -> FloatArray:
    return np.asarray(observations, dtype=np.float64)


def option(*points: float) -> SubgoalOption:
    initiation = Region(np.array(points)[:, None], np.ones(1), 0.25)
    return SubgoalOption(
        Region(np.zeros((1, 1)), np.ones(1), 0.25), initiation, TabularPolicy(np.ones((1, 1)), np.eye(2)[:1])
    )


def installed(*options: Option) -> Any:
    bank = OptionBank(2, 4, feature_map=places)
    for each in options:
        bank.add(each)
    return SimpleNamespace(bank=bank, installed=lambda: bank.filled, features_of=places)


def run(ended: str, *passed: float) -> OptionRun:
    there = np.array(passed)[:, None]
    return OptionRun(0, len(passed), 0.9, 0.9, ended, there, inside=True)  # type: ignore[arg-type]  # an ending


@pytest.mark.parametrize("ended", ["max_duration", "left_initiation"])
def test_states_from_where_runs_do_not_arrive_leave_the_initiation_set(ended: str) -> None:
    reliability, options = Reliability(0.5), installed(option(FINE, CIRCLE, FAR))
    for _ in range(MIN_PASSES):
        reliability.add(run(ended, CIRCLE, CIRCLE + 0.1, CIRCLE))  # passed once, however long
    for _ in range(RUNS_BETWEEN):
        reliability.add(run("subgoal", FAR, FINE))
    ((slot, later),) = reliability.judged(options)
    assert slot == 0
    assert later is not None
    assert later.initiation_set.points.ravel().tolist() == [FINE, FAR]
    assert later.subgoal is options.bank[0].subgoal
    assert not list(reliability.judged(options)), "its runs count from now on"


@pytest.mark.parametrize(("n_circles", "n_others", "others"), [(MIN_PASSES - 1, RUNS_BETWEEN, FINE), (12, 13, CIRCLE)])
def test_few_runs_and_half_of_them_are_not_enough(n_circles: int, n_others: int, others: float) -> None:
    reliability = Reliability(0.5)
    for _ in range(n_circles):
        reliability.add(run("max_duration", CIRCLE))
    for _ in range(n_others):
        reliability.add(run("subgoal", others))
    assert not list(reliability.judged(installed(option(FINE, CIRCLE))))


def test_an_option_is_closed_where_every_state_is_to_blame() -> None:
    reliability, options = Reliability(0.5), installed(option(FINE))
    for n in range(1, MIN_RUNS + 1):
        reliability.add(run("max_duration", FINE))
        assert list(reliability.judged(options)) == ([(0, None)] if n == MIN_RUNS else [])


def test_an_option_is_closed_where_no_state_is_to_blame() -> None:
    """Every run goes on for ever, each from another state."""
    reliability, options = Reliability(0.5), installed(option(*range(MIN_RUNS)))
    for n in range(MIN_RUNS):
        reliability.add(run("max_duration", n))
    assert list(reliability.judged(options)) == [(0, None)]


def test_an_option_that_leaves_its_initiation_set_stays() -> None:
    reliability, options = Reliability(0.5), installed(option(FINE))
    for _ in range(WINDOW):
        reliability.add(run("left_initiation", FINE))
    assert not list(reliability.judged(options))


def test_a_hand_made_option_is_never_judged() -> None:
    reliability, options = Reliability(0.5), installed(Option(places, places, places))
    for _ in range(WINDOW):
        reliability.add(run("left_initiation", FINE))
    assert not list(reliability.judged(options))


def test_only_runs_that_nobody_cut_off_count() -> None:
    reliability = Reliability(0.5)
    for ended in (
        ["subgoal"] * 20 + ["left_initiation"] * 10 + ["max_duration"] * 19 + ["truncated", "interrupted"] * 20
    ):
        reliability.add(run(ended, FINE))
    assert reliability.ended(0) is None
    reliability.add(run("max_duration", FINE))
    assert reliability.ended(0) == 30 / MIN_RUNS
    reliability.forget(0)
    assert reliability.ended(0) is None


def test_without_a_bound_nothing_is_kept() -> None:
    reliability = Reliability(0.0)
    reliability.add(run("subgoal", FINE))
    assert reliability.get_state() == {"runs": {}, "since": {}}


def test_a_state_goes_on() -> None:
    reliability, later = Reliability(0.5), Reliability(0.5)
    options = installed(option(FINE, CIRCLE))
    for _ in range(RUNS_BETWEEN - 1):
        reliability.add(run("max_duration", CIRCLE))
    later.set_state(reliability.get_state())
    later.add(run("max_duration", CIRCLE))
    ((_, narrower),) = later.judged(options)
    assert narrower is not None
    assert narrower.initiation_set.points.ravel().tolist() == [FINE]
