"""Each method against an oracle, or on experience whose bottleneck is known."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from experiments.methods.left_out import FirstVisits
from experiments.random_walks.conditions import is_bottleneck, run, world_for
from sb3_options.discovery.methods import METHODS, MethodName
from sb3_options.discovery.methods.method import Experience
from sb3_options.discovery.methods.random_places import RandomPlaces
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty, relative_novelty
from sb3_options.experience.observations import FloatArray, IntArray
from tests.support.helpers import line


def experience(
    places: Sequence[float] | IntArray, *, success: bool = True, allowed: Any = None, scale: float = 1.0
) -> Experience:
    """A trajectory through places on a line."""
    lived = line([float(place) for place in places], is_success=success)
    lived = dataclasses.replace(lived, success=success)
    may_be = np.ones(len(lived.features), dtype=bool) if allowed is None else np.array(allowed)
    return Experience(lived, lambda: may_be, scale=np.full(1, scale), radius=0.5)


class TestExperience:
    def test_states_that_differ_by_less_than_a_unit_are_one_place(self) -> None:
        lived = experience([0.0, 0.4, 2.0, 0.4], allowed=[True, False, True])
        assert lived.places.points.tolist() == [[0.0], [2.0]]
        assert lived.places.visits.tolist() == [0, 0, 1, 0]
        assert lived.places.allowed.tolist() == [False, True]

    def test_a_unit_is_one_after_scaling(self) -> None:
        assert len(experience([0, 1, 2, 3], scale=0.4).places.points) == 2
        assert len(experience([0, 1, 2, 3], scale=2.0).places.points) == 4


class TestRelativeNovelty:
    def test_it_is_what_the_definition_says(self, rng: np.random.Generator) -> None:
        visits, lag = rng.integers(6, size=60), 4
        counts = [int((visits[: t + 1] == visits[t]).sum()) for t in range(60)]

        def novelty(some: list[int]) -> float:
            return 1 / math.sqrt(np.mean(some))

        times, found = relative_novelty(visits, lag)
        assert times.tolist() == list(range(lag, 60 - lag))
        for t, value in zip(times, found, strict=True):
            assert value == pytest.approx(novelty(counts[t : t + lag + 1]) / novelty(counts[t - lag : t]))

    def test_what_leads_to_new_places_is_proposed(self) -> None:
        method = RelativeNovelty(lag=3, odds=100.0)
        known = [0, 1, 2] * 20
        assert method.update(experience([*known, 3, *range(10, 20)])) == []  # once may be an accident
        best, *_ = method.update(experience([*known, 3, *range(10, 20)]))
        assert best.points[0, 0] in (3.0, 10.0, 11.0)
        assert RelativeNovelty(lag=3).update(experience([0, 1, 2] * 30)) == []

    def test_a_short_trajectory_says_nothing(self) -> None:
        assert RelativeNovelty().update(experience([0, 1, 2])) == []


class TestRules:
    def test_more_likely_is_the_likelihood_ratio(self) -> None:
        p, q, odds = 0.3, 0.1, 5.0
        accept = RelativeNovelty(p_target=p, p_other=q, odds=odds)._accepted
        for n in (1, 10, 40):
            for k in range(n + 1):
                ratio = p**k * (1 - p) ** (n - k) / (q**k * (1 - q) ** (n - k))
                assert (accept(np.array([n]), np.array([k]))[0] > 0) == (ratio > odds)

    def test_memory_is_bounded(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("sb3_options.discovery.methods.candidates.MAX_PLACES", 3)
        method = FirstVisits()
        for visits in ([0, 1], [0, 2, 3], [4]):
            method.update(experience(visits))
        assert method._points.ravel().tolist() == [0.0, 1.0, 2.0]
        assert method._counts.tolist() == [[2, 2, 1], [1, 1, 1], [1, 1, 1]]

    def test_equals_are_proposed_in_the_order_in_which_they_were_seen(self) -> None:
        class Given(RelativeNovelty):
            def _accepted(self, seen: FloatArray, hits: FloatArray) -> FloatArray:
                return np.where(seen > 1, 0.5, 0.25) * (hits > 0)

        places = np.arange(100)
        lived, seen = experience(places), 1 + places % 2
        proposed = [r.points[0, 0] for r in Given()._counted(lived, seen, (places != 7).astype(np.int64))]
        assert proposed == [*(p for p in range(1, 100, 2) if p != 7), *range(0, 100, 2)]


@pytest.mark.parametrize("name", METHODS)
def test_every_method_proposes_regions_around_what_was_seen(name: MethodName, rng: np.random.Generator) -> None:
    method = METHODS[name]()
    for _ in range(12):
        lived = experience([*rng.integers(0, 3, 60), 3, *range(10, 20)])
        proposed = method.update(lived)
        for region in proposed:
            assert (region.points.shape, region.radius) == ((1, 1), 0.5)
            assert region.points[0, 0] in lived.features
    assert proposed


def test_relative_novelty_finds_the_doorway_of_two_rooms_from_random_walks() -> None:
    first, *_ = run("TwoRooms", {"method": "relative-novelty"}, seed=0, n_episodes=14)["found"]
    assert is_bottleneck(world_for("TwoRooms", 0), first["point"])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RelativeNovelty(p_target=0.1, p_other=0.2), "p_target must be above p_other"),
        (lambda: RelativeNovelty(odds=math.inf), "odds\n.*finite"),
        (lambda: RandomPlaces(min_successes=0), "min_successes\n.*greater than or equal to 1"),
    ],
)
def test_arguments_out_of_range_are_refused_by_name(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
