"""Peaks that gradient search and exhaustive search find: the door, what was planted, ties."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.distance import pdist

from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity, Peak
from sb3_options.density.log_density import log_diverse_density
from tests.density.planted import DOOR, planted, two_rooms


def by_the_door(peak: Peak) -> bool:
    return bool(np.abs(np.round(peak.point) - DOOR).max() <= 1)


def test_two_rooms_best_peak_is_at_the_door() -> None:
    assert sum(by_the_door(DiverseDensity().search(two_rooms(seed))[0]) for seed in range(10)) >= 9


@pytest.mark.parametrize("drift", [0.0, 0.15])
def test_gradient_search_is_as_good_as_exhaustive(drift: float) -> None:
    for seed in range(10 if drift else 4):  # without drift a walk takes thousands of steps
        bags = two_rooms(seed, drift)
        best = DiverseDensity(method="exhaustive").search(bags)[0].log_density
        assert DiverseDensity().search(bags)[0].log_density >= best - 1e-9


@pytest.mark.parametrize("n_negative", [0, 3])
def test_peaks(n_negative: int) -> None:
    bags = planted(0, n_negative)
    search = DiverseDensity()
    peaks = search.search(bags)
    values = [peak.log_density for peak in peaks]
    assert values == sorted(values, reverse=True)
    np.testing.assert_allclose(search.log_density([p.point for p in peaks], bags), values, rtol=1e-12)
    assert np.linalg.norm(peaks[0].point - [3, -2]) < 0.5
    assert peaks[0].converged
    assert (pdist([peak.point for peak in peaks]) > 0.5).all()
    t = torch.tensor(peaks[0].point[None], requires_grad=True)
    (slope,) = torch.autograd.grad(log_diverse_density(t, 1.0, bags), t)
    assert slope.abs().max() < 0.1


def test_no_peak_is_worse_than_the_best_start() -> None:
    for seed in range(5):
        bags = planted(seed, 2)
        best = DiverseDensity().log_density(bags.smallest_positive(3), bags).max()
        assert DiverseDensity().search(bags)[0].log_density >= best


@pytest.mark.parametrize("method", ["gradient", "exhaustive", "thorough"])
def test_with_a_leak_the_place_of_most_bags_beats_the_middle(method: Any) -> None:
    most, few, between = [[0.0, 0.0]], [[6.0, 0.0]], [[3.0, 0.0]]
    bags = Bags.pack([np.array(most)] + [np.array(most + between)] * 5 + [np.array(few)] * 4)

    def best(leak: float) -> float:
        return float(DiverseDensity(method=method, leak=leak).search(bags)[0].point[0])

    assert 2.5 < best(0.0) < 4.5  # near all bags, and where few pass
    assert best(0.2) == pytest.approx(0.0, abs=0.1)


def test_search_is_deterministic() -> None:
    first, second = (DiverseDensity().search(planted(1, 2)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.point, b.point)
        assert a.log_density == b.log_density


def test_warm_start_reaches_what_the_smallest_bag_misses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_options.density.diverse_density.SMALLEST_BAGS", 1)
    rng = np.random.default_rng(13)
    positive = [np.vstack([rng.uniform(-10, 10, size=(20, 2)), rng.normal([3, -2], 0.3)]) for _ in range(15)]
    bags = Bags.pack([np.array([[3.0, 3.0]]), *positive])
    search = DiverseDensity()
    cold, warm = search.search(bags), search.search(bags, starts=[[2.5, -1.5]])
    assert warm[0].log_density > cold[0].log_density + 1
    assert np.linalg.norm(warm[0].point - [3, -2]) < 1
    again = search.search(bags, starts=[peak.point for peak in warm])
    assert again[0].log_density >= warm[0].log_density


def test_starts_allow_a_search_without_positive_bags() -> None:
    bags, start = Bags.pack([], [np.zeros((1, 2))]), [[0.5, 0.0]]
    best = DiverseDensity().search(bags, starts=start)[0]
    assert best.point[0] > 0.5
    assert best.log_density > DiverseDensity().log_density(start, bags)[0]


def test_an_unmoved_peak_is_the_instance_itself() -> None:
    instance = np.array([[0.1, 1e3 + 0.7]])
    peak = DiverseDensity().search(Bags.pack([np.vstack([[[5.0, 1e3]], instance]), instance]))[0]
    np.testing.assert_array_equal(peak.point, instance[0])
    assert peak.log_density == 0.0


def test_exhaustive_search_returns_the_ties_in_order() -> None:
    shared = np.array([[5.0, 5.0], [1.0, 1.0]])
    bags = Bags.pack([np.vstack([shared, shared[:1], [[9.0, 0.0]]]), shared[::-1]])
    ties = DiverseDensity(method="exhaustive").search(bags)
    assert [peak.point.tolist() for peak in ties] == [[5.0, 5.0], [1.0, 1.0]]
    assert {peak.log_density for peak in ties} == {0.0}
    given = DiverseDensity(method="exhaustive").search(bags, starts=[[1.0, 1.0], [0.0, 9.0], [5.0, 5.0]])
    assert [peak.point.tolist() for peak in given] == [[1.0, 1.0], [5.0, 5.0]]


def test_gradient_search_returns_all_ties_too() -> None:
    shared = np.random.default_rng(14).permutation(30)[:20].astype(np.float64)[:, None] * 3
    bags = Bags.pack([np.vstack([shared, [[100.0 + i]]]) for i in range(4)])
    peaks = DiverseDensity().search(bags)
    assert [peak.point.tolist() for peak in peaks] == shared.tolist()
    assert {peak.log_density for peak in peaks} == {0.0}
    assert all(peak.converged for peak in peaks)


@pytest.mark.parametrize("method", ["gradient", "exhaustive"])
@pytest.mark.parametrize("n_shared", [0, 1, 5])
def test_what_every_bag_holds_is_known_without_a_search(rng: np.random.Generator, n_shared: int, method: Any) -> None:
    engine = DiverseDensity(scale=[1.0, 1.5], method=method, leak=0.3)
    for _ in range(10):
        shared = rng.choice(25, n_shared, replace=False) + 100
        held = [rng.permutation([*shared, *rng.choice(100, rng.integers(1, 9), replace=False)]) for _ in range(5)]
        bags = [np.column_stack([numbers % 5, numbers // 5]).astype(np.float64) for numbers in held]
        starts = bags[4][:3]
        certain = engine.certain(bags, starts)
        found = engine.search(Bags.pack(bags), starts=starts if method == "gradient" else None)
        tied = [peak for peak in found if peak.log_density >= -1e-9] if n_shared else []
        assert [peak.point.tolist() for peak in certain] == [peak.point.tolist() for peak in tied]
        assert all((peak.log_density, peak.converged) == (0.0, True) for peak in certain)
        assert len(certain) == n_shared


def test_where_instances_are_close_nothing_is_certain() -> None:
    """What lies between them is as dense as what every bag holds, and a search finds it."""
    way = np.arange(9.0)[:, None]
    bags = [way, way[1:], way[:8]]
    assert len(DiverseDensity(scale=1.0).certain(bags)) == 7
    assert DiverseDensity(scale=0.5).certain(bags) == []
