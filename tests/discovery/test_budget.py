"""The share of training that discovery may take: counted in work, so that no clock decides what is found."""

import copy
import itertools
import time
from typing import Any

import numpy as np
import pytest

from experiments.random_walks.conditions import run
from sb3_options.density.groups import FeatureGroup
from sb3_options.discovery.bags import FilteredBags
from sb3_options.discovery.budget import SHORTEST, STEP_SECONDS, TABLE_STEP_SECONDS
from sb3_options.discovery.diary import Diary
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.filters import Filters
from sb3_options.discovery.methods import Experience
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import Trajectory
from sb3_options.state import restore, state_of
from tests.discovery.told import Told, of


def wide(n: int = 40, d: int = 300, seed: int = 0) -> tuple[Trajectory, np.ndarray]:
    """A success whose states are all far from those of another seed, but for the one in the middle."""
    states = 100.0 * np.random.default_rng(seed).standard_normal((n, d))
    states[n // 2] = 1e-6 * seed
    visits, none = np.arange(n), np.zeros(n - 1)
    return Trajectory(states, visits, none.astype(np.int64), none, True, False, True), states


def costly(**settings: Any) -> Discovery:
    usual = {"min_positive": 2, "min_passing": 0.0, "threshold": 0.9999999, "search": "exhaustive", "max_share": 0.5}
    return Discovery(DiscoverySettings(**{**usual, **settings}), kind="environment")


def searches(discovery: Discovery, seed: int, **size: int) -> bool:
    """Whether there is a search after another trajectory."""
    discovery.add(*wide(seed=seed, **size))
    skipped = discovery.diary.skipped
    discovery.search()
    return discovery.diary.skipped == skipped


def searches_of(discovery: Discovery, n: int = 30) -> list[bool]:
    return [searches(discovery, seed) for seed in range(n)]


class TestDiary:
    def test_a_share_of_what_training_takes_or_would_take_if_it_were_longer(self) -> None:
        diary = Diary(max_share=0.1)
        diary.spent = 0.1 * SHORTEST * STEP_SECONDS
        assert diary.affords()
        diary.spent *= 1.01
        diary.steps = SHORTEST
        assert not diary.affords()
        assert not diary.affords()
        assert diary.skipped == 2
        diary.steps = int(1.1 * SHORTEST)
        assert diary.affords()

    def test_a_step_of_a_table_takes_less(self) -> None:
        diary = Diary(max_share=0.1, spent=0.2 * SHORTEST * TABLE_STEP_SECONDS, steps=2 * SHORTEST - 1)
        assert diary.affords()
        diary.step_seconds = TABLE_STEP_SECONDS
        assert not diary.affords()
        diary.steps += 1
        assert diary.affords()


def seconds_of_search(sizes: list[int], d: int, kind: str) -> float:
    """Nominal seconds of a search of positive bags of these sizes."""
    settings, method = DiscoverySettings(), PersistentPeaks()
    method.begin(settings, Filters(settings, kind=kind))
    return method._seconds_of_search(FilteredBags([np.zeros((n, d)) for n in sizes], []), method.engine())


@pytest.mark.parametrize(
    ("n", "tried", "d", "measured"), [(98, 12, 2, 0.0025), (1200, 4, 147, 0.02), (1700, 10, 2352, 0.32)]
)
def test_a_search_takes_about_what_was_measured(n: int, tried: int, d: int, measured: float) -> None:
    seconds = seconds_of_search([n - tried, tried - 2, 1, 1], d, "environment")
    assert measured / 2 < seconds < 2 * measured


@pytest.mark.parametrize(("n", "d", "measured"), [(300, 500, 0.0018), (2000, 500, 0.010), (5000, 2000, 0.227)])
def test_a_search_among_one_hot_codes_takes_about_what_was_measured(n: int, d: int, measured: float) -> None:
    assert measured / 2.5 < seconds_of_search([n], d, "categorical") < 2.5 * measured


class TestSchedule:
    @pytest.fixture(autouse=True)
    def _short(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Trainings of a few trajectories, so that the budget is soon spent."""
        monkeypatch.setattr("sb3_options.discovery.diary.SHORTEST", 1000)

    def test_costly_searches_become_rarer(self) -> None:
        discovery = costly()
        made = searches_of(discovery, 60)
        assert all(made[:10])  # in advance
        assert 0 < sum(made[-40:]) < 10
        allowed = 0.5 * STEP_SECONDS * discovery.diary.steps
        assert allowed < discovery.diary.spent < 2 * allowed

    def test_who_finds_nothing_is_told(self) -> None:
        discovery = costly()
        searches_of(discovery)
        remedy = "searches were left out to save time: raise max_share (--discovery.max-share)."
        assert f" {discovery.diary.skipped} {remedy}" in discovery.why_nothing()
        assert "left out" not in costly().why_nothing()

    def test_a_larger_share_affords_more(self) -> None:
        few, more, every = (sum(searches_of(costly(max_share=share))) for share in (0.05, 0.5, None))
        assert few < more < every == 30

    def test_the_clock_decides_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        made = searches_of(costly())
        seconds = itertools.count(0.0, 1000.0)
        monkeypatch.setattr(time, "process_time", lambda: next(seconds))
        slow = costly()
        assert searches_of(slow) == made
        assert slow.diary.seconds > 1000.0

    def test_a_state_goes_on_with_the_same_schedule(self) -> None:
        whole, cut, resumed = costly(), costly(), costly()
        made = searches_of(whole)
        assert any(made[20:])
        assert searches_of(cut, 20) == made[:20]
        restore(resumed, copy.deepcopy(state_of(cut)))
        assert [searches(resumed, seed) for seed in range(20, 30)] == made[20:]
        assert (resumed.diary.spent, resumed.diary.skipped) == (whole.diary.spent, whole.diary.skipped)


def test_groups_keep_to_it_too() -> None:
    groups = [FeatureGroup(str(i), (i,)) for i in range(30)]
    discovery = Discovery(DiscoverySettings(min_positive=2, max_share=0.05), groups=groups)
    assert not all(searches(discovery, seed, n=8, d=30) for seed in range(150))
    assert discovery.diary.spent < 0.1 * SHORTEST * STEP_SECONDS


@pytest.mark.parametrize("method", ["diverse-density", "relative-novelty"])
def test_where_searches_are_cheap_none_is_left_out(method: str) -> None:
    some, every = (run("FourRooms", {"method": method, **more}, 0, n_episodes=30) for more in ({}, {"max_share": None}))
    assert some | {"seconds": 0} == every | {"seconds": 0}


@pytest.mark.parametrize(("seconds", "told"), [(0.0, 30), (0.1, 6)])
def test_a_method_is_not_told_what_would_cost_too_much(seconds: float, told: int) -> None:
    class Slow(Told):
        def seconds(self, experience: Experience) -> float:
            return seconds

    method = Slow()
    discovery = of(method)
    assert sum(searches(discovery, seed, n=8, d=2) for seed in range(30)) == len(method.told) == told
    assert discovery.diary.spent == pytest.approx(told * (seconds + 3.6e-4 + 7 * 5e-7 + 16 * 2e-8))
