from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_options.callbacks.usefulness import (
    MIN_PASSES,
    MIN_RUNS,
    MIN_SUCCESSES,
    RUNS_BETWEEN,
    WINDOW,
    Ending,
    Episode,
    Usefulness,
    verdict,
)
from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray, Observations
from sb3_options.experience.option_run import OptionRun
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import PolicyInput, TabularPolicy
from sb3_options.options.settings import UsefulnessSettings

FINE, CIRCLE, FAR = 1.0, 2.0, 3.0
"""Places on a line; the subgoal is at 0."""

UNSURE = [Episode(ran=True, success=False)] * 50
"""Episodes that do not show that an option helps."""


def places(observations: Observations) -> FloatArray:
    return np.asarray(observations, dtype=np.float64)


def option(*points: float, subgoal: float = 0.0) -> SubgoalOption:
    initiation = Region(np.array(points)[:, None], np.ones(1), 0.25)
    goal = Region(np.full((1, 1), subgoal), np.ones(1), 0.25)
    return SubgoalOption(goal, initiation, TabularPolicy(np.ones((1, 1)), np.eye(2)[:1]))


def installed(*options: Option) -> Any:
    bank = OptionBank(2, 4, feature_map=places)
    for each in options:
        bank.add(each)
    return SimpleNamespace(bank=bank, installed=lambda: bank.filled, features_of=places)


def add(useful: Usefulness, ended: str, *passed: float, success: bool | None = None) -> None:
    there = np.array(passed)[:, None]
    run = OptionRun(0, len(passed), 0.9, 0.9, ended, there, inside=True)  # type: ignore[arg-type]  # an ending
    useful.add(run, 0, success=success)


def judging(**settings: Any) -> Usefulness:
    return Usefulness(UsefulnessSettings(**settings))


@pytest.mark.parametrize(
    ("shares", "why"),
    [
        ({"left_initiation": 1.0}, "does not arrive"),
        ({"subgoal": 0.01, "failed": 0.5, "left_initiation": 0.49}, "does not arrive"),  # PutNear, "key at forward 0"
        ({"max_duration": 0.8, "subgoal": 0.2}, "goes in circles"),
        ({"failed": 0.8, "subgoal": 0.2}, "ends in failure"),
        ({"subgoal": 1.0}, None),
        ({"subgoal": 0.12, "left_initiation": 0.88}, None),  # to close such options did harm
        ({"subgoal": 0.7, "failed": 0.3}, None),
    ],
)
def test_the_verdict_follows_how_runs_end(shares: dict[Ending, float], why: str | None) -> None:
    endings: list[Ending] = [ending for ending, share in shares.items() for _ in range(round(share * WINDOW))]
    assert verdict(endings, UNSURE, 0.5) == why
    assert verdict(endings[: MIN_RUNS - 1], UNSURE, 0.5) is None


@pytest.mark.parametrize("ending", ["failed", "left_initiation"])
@pytest.mark.parametrize("helps", [True, False])
def test_an_option_that_helps_episodes_to_succeed_stays(ending: Ending, helps: bool) -> None:
    """In lava most runs of primitive actions end in failure, too."""
    episodes = [Episode(ran, success=ran is helps and n % 3 > 0) for n in range(40) for ran in (True, False)]
    assert (verdict([ending] * WINDOW, episodes, 0.5) is None) == helps


@pytest.mark.parametrize("arrives", [0.5, 0.75, 0.95])
@pytest.mark.parametrize("otherwise", ["max_duration", "left_initiation", "failed"])
def test_an_option_that_arrives_is_hardly_ever_closed(arrives: float, otherwise: Ending) -> None:
    """500 options with 400 runs each; at the bound itself each of 15 judgements errs with 0.01 at most."""
    rng = np.random.default_rng(0)
    closed = 0
    for _ in range(500):
        runs: list[Ending] = ["subgoal" if arrived else otherwise for arrived in rng.random(400) < arrives]
        looks = (runs[:end][-WINDOW:] for end in range(MIN_RUNS, 401, RUNS_BETWEEN))
        closed += any(verdict(look, UNSURE, 0.5) for look in looks)
    assert closed <= (40 if arrives == 0.5 else 0)


@pytest.mark.parametrize("ended", ["max_duration", "left_initiation"])
def test_states_from_where_runs_do_not_arrive_leave_the_initiation_set(ended: str) -> None:
    useful, options = judging(), installed(option(FINE, CIRCLE, FAR))
    for _ in range(MIN_PASSES):
        add(useful, ended, CIRCLE, CIRCLE + 0.1, CIRCLE)  # passed once, however long
    for _ in range(RUNS_BETWEEN):
        add(useful, "subgoal", FAR, FINE)
    ((slot, later),) = useful.judged(options)
    assert slot == 0
    assert isinstance(later, SubgoalOption)
    assert later.initiation_set.points.ravel().tolist() == [FINE, FAR]
    assert later.subgoal is options.bank[0].subgoal
    assert not list(useful.judged(options)), "its runs count from now on"


def test_an_option_that_loses_states_and_still_does_not_arrive_is_closed() -> None:
    """In PutNear "key at forward 0" lost states again and again, and arrived in none of its last hundreds of runs."""
    useful, options = judging(), installed(option(FINE, CIRCLE, FAR))
    yielded = []
    for _ in range(WINDOW // RUNS_BETWEEN):
        for _ in range(RUNS_BETWEEN):
            add(useful, "left_initiation", CIRCLE)
        yielded += [what if isinstance(what, str) else "loses states" for _, what in useful.judged(options)]
    assert yielded == ["loses states", "loses states", "loses states", "does not arrive"]


def test_of_an_option_that_arrives_too_seldom_every_state_leaves_that_does() -> None:
    """No state alone is surely to blame: in LavaGapS6 such an option stayed, though 0.3 of its runs arrived."""
    useful, options = judging(), installed(option(FINE, CIRCLE, FAR, 4.0))
    for n in range(30):
        for place in (CIRCLE, FAR, 4.0):
            add(useful, "subgoal" if n % 3 == 0 else "left_initiation", place)
    for n in range(MIN_PASSES):
        add(useful, "subgoal" if n % 2 == 0 else "left_initiation", FINE)
    ((_, later),) = useful.judged(options)
    assert isinstance(later, SubgoalOption)
    assert later.initiation_set.points.ravel().tolist() == [FINE]


@pytest.mark.parametrize("helped", [True, False])
def test_an_option_that_arrives_from_nowhere_often_enough_is_closed_unless_it_helps(helped: bool) -> None:
    """Episodes are those of the environment in which it ran: environment 0."""
    useful, options = judging(), installed(option(FINE, CIRCLE))
    for n in range(MIN_RUNS):
        add(useful, "subgoal" if n % 10 < 3 else "left_initiation", FINE, CIRCLE)
        useful.episode_ended(0, [0], success=helped)
        useful.episode_ended(1, [0], success=not helped)
    assert list(useful.judged(options)) == ([] if helped else [(0, "does not arrive")])


@pytest.mark.parametrize("n_circles", [MIN_PASSES - 1, 12])
def test_few_runs_and_half_of_them_are_not_enough(n_circles: int) -> None:
    useful = judging()
    for _ in range(n_circles):
        add(useful, "max_duration", CIRCLE)
    for _ in range(RUNS_BETWEEN - n_circles):
        add(useful, "subgoal", CIRCLE if n_circles == 12 else FINE)
    assert not list(useful.judged(installed(option(FINE, CIRCLE))))


@pytest.mark.parametrize("points", [(FINE,), tuple(range(MIN_RUNS))])
def test_an_option_is_closed_where_no_state_is_to_blame_or_every_one(points: tuple[float, ...]) -> None:
    useful, options = judging(), installed(option(*points))
    for n in range(MIN_RUNS):
        add(useful, "max_duration", points[n % len(points)])
        assert list(useful.judged(options)) == ([(0, "goes in circles")] if n == MIN_RUNS - 1 else [])


def test_only_failures_and_runs_that_nobody_cut_off_count() -> None:
    useful, options = judging(), installed(option(FINE))
    for _ in range(WINDOW):
        add(useful, "truncated", FINE, success=False)
        add(useful, "terminated", FINE, success=True)
    assert not list(useful.judged(options))
    for _ in range(MIN_RUNS):
        add(useful, "terminated", FINE, success=False)
    assert list(useful.judged(options)) == [(0, "ends in failure")]


@pytest.mark.parametrize(
    ("given", "settings"), [(Option(places, places, places), {}), (option(FINE), {"min_reached": 0})]
)
def test_hand_made_options_are_not_judged_and_none_where_judging_is_off(given: Option, settings: Any) -> None:
    useful, options = judging(**settings), installed(given)
    for _ in range(WINDOW):
        add(useful, "left_initiation", FINE)
        useful.episode_ended(0, [0], success=False)
    assert not list(useful.judged(options))
    assert not useful.counts_needs(options)


def test_the_option_that_fewest_successes_need_gives_place() -> None:
    useful, options = judging(), installed(option(FINE, subgoal=0.0), option(FINE, subgoal=7.0))
    for n in range(MIN_SUCCESSES):
        assert useful.unneeded(options) is None
        useful.succeeded(options, np.array([[FINE], [0.0 if n % 2 else FAR]]))  # half of them pass the first one
    assert useful.unneeded(options) == 1
    useful.forget(1)
    assert useful.unneeded(options) is None


def acting(policy_input: PolicyInput, actions: dict[float, int]) -> SubgoalOption:
    """Of two actions those at these places, which are where it may begin."""
    at = np.array(list(actions))[:, None]
    policy = TabularPolicy(at, np.eye(2)[list(actions.values())])
    goal = Region(np.zeros((1, 1)), np.ones(1), 0.25)
    return SubgoalOption(goal, Region(at, np.ones(1), 0.25), policy, policy_input=policy_input, feature_map=places)


class TestLearnedAnew:
    """What I lost stays out of an option that is learned anew, while the policy does what it did there."""

    def lost(self, policy_input: PolicyInput = "features") -> Usefulness:
        useful, options = judging(), installed(acting(policy_input, {FINE: 0, CIRCLE: 1, FAR: 0}))
        for n in range(RUNS_BETWEEN):
            add(useful, *(("max_duration", CIRCLE) if n < MIN_PASSES else ("subgoal", FAR, FINE)))
        ((_, later),) = useful.judged(options)
        assert isinstance(later, SubgoalOption)
        return useful

    @pytest.mark.parametrize("policy_input", ["features", "observation"])
    def test_what_was_lost_stays_out(self, policy_input: PolicyInput) -> None:
        anew = self.lost(policy_input).learned_anew(0, acting(policy_input, {FINE: 1, CIRCLE: 1, FAR: 1, 4.0: 1}))
        assert anew is not None
        assert anew.initiation_set.points.ravel().tolist() == [FINE, FAR, 4.0]

    def test_where_the_policy_does_something_else_it_may_begin_again(self) -> None:
        anew = self.lost().learned_anew(0, acting("features", {FINE: 0, CIRCLE: 0, FAR: 0}))
        assert anew is not None
        assert CIRCLE in anew.initiation_set.points

    def test_nothing_is_left(self) -> None:
        assert self.lost().learned_anew(0, acting("features", {CIRCLE: 1})) is None

    @pytest.mark.parametrize("forget", ["another slot", "closed", "another map"])
    def test_what_was_lost_is_forgotten_with_its_option_and_its_map(self, forget: str) -> None:
        useful, circling = self.lost(), acting("features", {CIRCLE: 1})
        if forget == "closed":
            useful.forget(0)
        elif forget == "another map":
            useful.forget_places()
        assert useful.learned_anew(int(forget == "another slot"), circling) is circling
