from __future__ import annotations

import numpy as np
import pytest

from sb3_options.density import search as concept_search
from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.density.incremental import IncrementalSearch
from sb3_options.experience.observations import FloatArray

PLACE = np.array([3.0, -2.0])
STRENGTH = 0.1
ENGINE = DiverseDensity(negative_strength=STRENGTH)


def bags_of(rng: np.random.Generator, n: int) -> list[FloatArray]:
    """Noise with an instance a bag around a place common to all, anywhere in the bag."""
    return [
        rng.permutation(np.vstack([rng.uniform(-10, 10, (29, 2)), rng.normal(PLACE, 0.2, (1, 2))])) for _ in range(n)
    ]


def density(point: FloatArray, positive: list[FloatArray], negative: list[FloatArray]) -> float:
    return float(ENGINE.log_density(point[None], Bags.pack(positive, negative))[0])


@pytest.mark.parametrize("pairs", [1 << 21, 1])  # all instances of a bag are tried, or a few
def test_bags_that_come_and_go(monkeypatch: pytest.MonkeyPatch, pairs: int) -> None:
    monkeypatch.setattr(concept_search, "UPDATE_PAIRS", pairs)
    rng = np.random.default_rng(0)
    positive, negative = bags_of(rng, 40), [rng.uniform(-10, 10, (30, 2)) for _ in range(40)]
    grown = IncrementalSearch(ENGINE)
    for n in range(10, 41):
        last = slice(max(0, n - 20), n)
        peaks = grown.search(positive[last], negative[last])
        best = IncrementalSearch(ENGINE).search(positive[last], negative[last])[0]
        reference = max(best.log_density, density(peaks[0].point, positive[last], negative[last]))
        assert np.linalg.norm(peaks[0].point - PLACE) < 0.5
        assert peaks[0].log_density == pytest.approx(reference, abs=0.01)
        values = [peak.log_density for peak in peaks]
        assert values == sorted(values, reverse=True)


def test_a_bag_is_packed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bags = bags_of(np.random.default_rng(1), 12)
    grown = IncrementalSearch(ENGINE)
    grown.search(bags[:10])
    monkeypatch.setattr(concept_search.ConceptSearch, "evidence", None)  # not made anew
    assert grown.search(bags[2:])
    assert grown.search(bags[2:])


def test_other_bags_are_searched_anew() -> None:
    first, second = bags_of(np.random.default_rng(2), 10), [bag + 50 for bag in bags_of(np.random.default_rng(3), 10)]
    grown = IncrementalSearch(ENGINE)
    grown.search(first)
    peaks, again = grown.search(second), IncrementalSearch(ENGINE).search(second)
    assert [peak.point.tolist() for peak in peaks] == [peak.point.tolist() for peak in again]


def test_with_a_leak_a_bag_without_the_concept_hardly_counts() -> None:
    rng = np.random.default_rng(4)
    bags = [*bags_of(rng, 9), np.array([[40.0, 40.0]])]
    search = IncrementalSearch(DiverseDensity(leak=0.2))
    for n in (5, len(bags)):
        best = search.search(bags[:n])[0]
    assert np.linalg.norm(best.point - [3, -2]) < 0.5
    assert best.log_density > np.log(0.2) - 3


def test_scaled_features() -> None:
    scale = np.array([10.0, 0.1])
    engine = DiverseDensity(scale=scale, negative_strength=STRENGTH)
    peaks = IncrementalSearch(engine).search([bag / scale for bag in bags_of(np.random.default_rng(4), 20)])
    assert np.linalg.norm(peaks[0].point * scale - PLACE) < 0.5
