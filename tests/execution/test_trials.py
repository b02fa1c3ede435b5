"""The statistics of an option's trial, and what is closed over many of them."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import hypergeom, mannwhitneyu, rankdata

from sb3_options.execution.interruption import Interruption
from sb3_options.execution.trials import OptionTrial, TrialSettings, Withholding, harm
from tests.support.helpers import steady_option


def closed_after(rng: np.random.Generator, effect: float, *, episodes: int = 1200, drift: float = 0.0) -> int | None:
    """Trial of an option that adds ``effect`` to normal returns of standard deviation 1; the episode that closed it."""
    trial = OptionTrial(TrialSettings())
    for episode in range(episodes):
        withheld = bool(rng.random() < trial.settings.withhold)
        outcome = rng.normal() + drift * episode + (0.0 if withheld else effect)
        if trial.add(withheld=withheld, outcome=outcome) is not None:
            return episode
    return None


def rate(effect: float, *, n: int = 40, drift: float = 0.0) -> tuple[float, float]:
    """Share of trials that closed the option, and the mean episode in which they did."""
    rng = np.random.default_rng(0)
    closed = [closed_after(rng, effect, drift=drift) for _ in range(n)]
    when = [c for c in closed if c is not None]
    return len(when) / n, float(np.mean(when)) if when else np.inf


@pytest.mark.parametrize("drift", [0.0, 0.01])
def test_an_option_without_effect_stays(drift: float) -> None:
    """Whatever the returns do meanwhile: at most α = 5 % are closed over 1,200 episodes."""
    share, _ = rate(0.0, n=80, drift=drift)
    assert share <= 0.05 + 3 * (0.05 * 0.95 / 80) ** 0.5


def test_a_helpful_option_stays() -> None:
    assert rate(0.5)[0] <= 0.02


@pytest.mark.parametrize(("effect", "most"), [(-2.0, 300.0), (-1.0, 500.0)])
def test_a_harmful_option_goes(effect: float, most: float) -> None:
    share, when = rate(effect)
    assert share == 1.0
    assert when < most


def test_harm_is_the_one_sided_mann_whitney_test() -> None:
    rng = np.random.default_rng(1)
    with_it, without_it = rng.normal(size=50), rng.normal(size=20) + 0.4
    expected = mannwhitneyu(without_it, with_it, alternative="greater").pvalue
    assert harm(with_it, without_it) == expected < 0.5
    assert harm(without_it, with_it) > 0.5


@pytest.mark.parametrize("n_good", [1, 2, 5, 30])
def test_of_two_outcomes_the_probability_is_exact(n_good: int) -> None:
    """Then U says how many of the good ones were without the option, which is hypergeometric."""
    outcomes = np.zeros(100)
    outcomes[:n_good] = 0.7
    for n_without in range(min(n_good, 10) + 1):
        without_it = np.r_[np.full(n_without, 0.7), np.zeros(10 - n_without)]
        with_it = np.r_[np.full(n_good - n_without, 0.7), np.zeros(90 - n_good + n_without)]
        assert harm(with_it, without_it) == pytest.approx(hypergeom.sf(n_without - 1, 100, n_good, 10))


@pytest.mark.parametrize("succeeds", [0.02, 0.1, 0.5, 0.95])
def test_an_option_without_effect_stays_where_few_or_nearly_all_succeed(succeeds: float) -> None:
    rng, settings = np.random.default_rng(0), TrialSettings()
    closed = 0
    for _ in range(150):
        trial = OptionTrial(settings)
        outcomes = (rng.random(500) < succeeds) * 0.95 ** rng.integers(10, 60, 500)
        drawn = rng.random(500) < settings.withhold
        closed += any(trial.add(withheld=bool(w), outcome=float(g)) for w, g in zip(drawn, outcomes, strict=True))
    assert closed / 150 <= 0.05 + 2 * (0.05 * 0.95 / 150) ** 0.5


def test_the_probability_is_that_of_random_draws() -> None:
    """Of 100 episodes, most of which have the same outcome, 10 are drawn again and again."""
    rng = np.random.default_rng(3)
    for succeeds in (0.1, 0.4, 0.8):
        outcomes = np.where(rng.random(100) < succeeds, 0.95 ** rng.integers(10, 30, 100), 0.0)
        ranks = rankdata(outcomes)
        sums = ranks[np.argsort(rng.random((20_000, 100)), axis=1)[:, :10]].sum(axis=1)
        for noise in (1e9, 60.0, 30.0):  # the less, the more of the best are drawn
            drawn = np.zeros(100, dtype=bool)
            drawn[np.argsort(ranks + rng.normal(size=100) * noise)[-10:]] = True
            exact = (sums >= ranks[drawn].sum() - 1e-9).mean()
            assert harm(outcomes[~drawn], outcomes[drawn]) == pytest.approx(exact, abs=0.04)


def test_a_rare_failure_beside_rare_successes_is_no_evidence() -> None:
    """Both of two successes among 10 of 104 episodes: 0.9 %; one of them failed worse than all others."""
    assert harm(np.r_[-5.0, np.zeros(93)], np.r_[np.zeros(8), 1.0, 1.0]) == pytest.approx(0.0077, abs=2e-4)


@pytest.mark.parametrize("n_without", [10, 30, 50])
@pytest.mark.parametrize("n_values", [2, 4, 20])
def test_there_is_a_probability_whatever_is_drawn(n_without: int, n_values: int) -> None:
    """Also where the outcomes that are no greater than the commonest are fewer than those without the option."""
    rng = np.random.default_rng(n_values)
    for _ in range(20):
        outcomes = np.where(rng.random(60) < 0.8, rng.integers(1, n_values + 1, 60) / 10, 0.0)
        ranks, drawn = rankdata(outcomes), rng.permutation(60)[:n_without]
        sums = ranks[np.argsort(rng.random((2000, 60)), axis=1)[:, :n_without]].sum(axis=1)
        exact = (sums >= ranks[drawn].sum() - 1e-9).mean()
        assert harm(np.delete(outcomes, drawn), outcomes[drawn]) == pytest.approx(exact, abs=0.06)


def test_a_return_that_is_nan_closes_nothing() -> None:
    assert harm(np.array([0.0, 0.0, 1.0, np.nan]), np.array([0.0, 1.0, 1.0])) == 1.0


def test_where_there_is_nothing_to_compare_there_is_no_harm() -> None:
    assert harm(np.zeros(0), np.ones(5)) == 1.0
    assert harm(np.ones(5), np.ones(5)) == 1.0


def test_alpha_is_spent_over_the_looks() -> None:
    """The criterion as it stands in the docs, look by look."""
    settings = TrialSettings(look_every=5, window=50)
    trial, rng = OptionTrial(settings), np.random.default_rng(2)
    seen: list[tuple[bool, float]] = []
    looks = 0
    for _ in range(400):
        withheld, outcome = bool(rng.random() < 0.5), float(rng.normal())
        outcome += 1.0 * withheld
        seen.append((withheld, outcome))
        verdict = trial.add(withheld=withheld, outcome=outcome)
        if withheld and sum(w for w, _ in seen) % 5 == 0:
            looks += 1
            last = seen[-50:]
            p = harm(np.array([g for w, g in last if not w]), np.array([g for w, g in last if w]))
            assert trial.p_value == p
            assert (verdict == "harmful") == (p <= 0.05 / (looks * (looks + 1)))
        else:
            assert verdict is None
        if verdict:
            return
    pytest.fail("no look found harm")


@pytest.mark.parametrize(("alpha", "verdict"), [(0.1, "harmful"), (0.05, None)])
def test_the_first_look_may_spend_half_of_alpha(alpha: float, verdict: str | None) -> None:
    """Two episodes without the option return more than five with it: P(U ≥ 10) = 2! 5! / 7! = 1/21, about 0.048."""
    trial = OptionTrial(TrialSettings(look_every=2, alpha=alpha))
    for outcome in range(5):
        assert trial.add(withheld=False, outcome=float(outcome)) is None
    assert trial.add(withheld=True, outcome=8.0) is None
    assert trial.add(withheld=True, outcome=9.0) == verdict
    assert trial.p_value == pytest.approx(1 / 21)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"withhold": 0.0}, "withhold should be greater than 0, got 0.0"),
        ({"alpha": 1.0}, "alpha should be less than 1, got 1.0"),
        ({"look_every": 0}, "look_every should be greater than or equal to 1, got 0"),
        ({"window": 2.5}, "window should be a valid integer, got a number with a fractional part, got 2.5"),
        ({"success_window": 0}, "success_window should be greater than or equal to 1"),
        ({"patience": -1}, "patience should be greater than or equal to 1"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=f"^TrialSettings: {match}"):
        TrialSettings(**settings)


def test_withholding_draws_each_slot_with_its_share_and_apart_from_the_others() -> None:
    withholding = Withholding([0], 0.9)
    withholding.shares = {0: 0.1, 2: 0.5}
    drawn = []
    for _ in range(4000):
        withholding.begin([0, 1, 2])
        drawn.append([slot in withholding.withheld() for slot in range(3)])
    shares = np.mean(drawn, axis=0)
    np.testing.assert_allclose(shares, [0.1, 0.0, 0.5], atol=0.03)
    both = np.mean([d[0] and d[2] for d in drawn])
    assert abs(both - 0.05) < 0.015


def test_withholding_reports_the_discounted_return_when_the_episode_is_over() -> None:
    withholding = Withholding([0], 0.5)
    withholding.begin([0])
    assert withholding.note([5.0], over=True) == {}  # nothing is tried
    withholding.shares = {0: 0.5}
    withholding.begin([0])
    assert withholding.note([1.0], over=False) == {}
    report = withholding.note([2.0, 3.0], over=True)["option_trial"]
    assert report["outcome"] == 1 + 1 + 0.75
    assert set(report["withheld"]) == {0}


class TestInsteadOfAWithheldOption:
    """Three primitives, of which 1 may not be taken, and two options; the option that was chosen takes 2."""

    MASK = np.array([True, False, True, True, True])

    def instead(self, action: int, values: list[float] | None, seed: int = 0) -> int:
        rule = None if values is None else Interruption(lambda _: np.array(values), masks=True)
        withholding = Withholding([seed], gamma=0.9)
        return withholding.instead_of(steady_option(2), action, np.zeros(1), lambda: self.MASK, 3, rule)

    def test_without_values_it_is_a_step_of_its_own_policy(self) -> None:
        assert self.instead(3, None) == 2

    def test_a_greedy_choice_gives_way_to_the_best_available_primitive(self) -> None:
        assert self.instead(3, [0.1, 9.0, 0.0, 1.0, 0.5]) == 0
        assert self.instead(3, [0.1, 9.0, 0.2, 1.0, 1.0]) == 2, "as good as the other option is the best choice too"
        assert self.instead(3, [-2.0, 9.0, -1.0, -0.5, -3.0]) == 2

    def test_an_exploratory_choice_gives_way_to_any_available_primitive(self) -> None:
        assert {self.instead(3, [0.1, 9.0, 0.0, 1.0, 1.5], seed) for seed in range(20)} == {0, 2}
