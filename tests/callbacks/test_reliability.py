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
from sb3_options.options.policies import PolicyInput, TabularPolicy

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
    assert reliability.get_state() == {"runs": {}, "judged": {}, "failed": {}}


def test_of_judged_runs_no_observation_is_kept() -> None:
    reliability, options = Reliability(0.5), installed(option(FINE, CIRCLE))
    for _ in range(2 * RUNS_BETWEEN):
        reliability.add(run("subgoal", CIRCLE, FINE))
        assert not list(reliability.judged(options))
        assert sum(map(len, reliability.get_state()["runs"].values())) < RUNS_BETWEEN
    (judged,) = reliability.get_state()["judged"].values()
    assert [(passed.tolist(), why) for passed, why in judged] == [([[CIRCLE], [FINE]], "subgoal")] * 2 * RUNS_BETWEEN
    assert reliability.ended(0) == 1.0


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


class TestLearnedAnew:
    """A state that I has lost comes back only where π does something else now."""

    def lost(self, policy_input: PolicyInput = "features") -> tuple[Reliability, SubgoalOption]:
        reliability, present = Reliability(0.5), acting(policy_input, {FINE: 0, CIRCLE: 1, FAR: 0})
        for n in range(RUNS_BETWEEN):
            reliability.add(run("max_duration", CIRCLE) if n < MIN_PASSES else run("subgoal", FAR, FINE))
        ((_, later),) = reliability.judged(installed(present))
        assert later is not None
        return reliability, later

    @pytest.mark.parametrize("policy_input", ["features", "observation"])
    def test_what_was_lost_stays_away(self, policy_input: PolicyInput) -> None:
        reliability, _ = self.lost(policy_input)
        anew = reliability.learned_anew(0, acting(policy_input, {FINE: 1, CIRCLE: 1, FAR: 1, 4.0: 1}))
        assert anew is not None
        assert anew.initiation_set.points.ravel().tolist() == [FINE, FAR, 4.0]

    def test_but_where_the_policy_has_changed(self) -> None:
        reliability, _ = self.lost()
        anew = reliability.learned_anew(0, acting("features", {FINE: 0, CIRCLE: 0, FAR: 0}))
        assert anew is not None
        assert anew.initiation_set.points.ravel().tolist() == [FINE, CIRCLE, FAR]

    def test_nothing_is_left(self) -> None:
        reliability, _ = self.lost()
        assert reliability.learned_anew(0, acting("features", {CIRCLE: 1})) is None

    def test_of_other_options_nothing_is_known(self) -> None:
        reliability, _ = self.lost()
        circling = acting("features", {CIRCLE: 1})
        assert reliability.learned_anew(1, circling) is circling
        reliability.forget(0)  # it is closed
        assert reliability.learned_anew(0, circling) is circling

    def test_nor_in_another_space(self) -> None:
        reliability, _ = self.lost()
        reliability.forget_places()
        circling = acting("features", {CIRCLE: 1})
        assert reliability.learned_anew(0, circling) is circling

    def test_it_is_in_a_checkpoint(self) -> None:
        reliability, _ = self.lost()
        resumed = Reliability(0.5)
        resumed.set_state(reliability.get_state())
        assert resumed.learned_anew(0, acting("features", {CIRCLE: 1})) is None


def acting(policy_input: PolicyInput, actions: dict[float, int]) -> SubgoalOption:
    """An option that may begin at each of some places, and what it does there."""
    places = np.array(list(actions))[:, None]
    policy = TabularPolicy(places, np.eye(2)[list(actions.values())])
    region = Region(places, np.ones(1), 0.25)
    return SubgoalOption(Region(np.zeros((1, 1)), np.ones(1), 0.25), region, policy, policy_input=policy_input)
