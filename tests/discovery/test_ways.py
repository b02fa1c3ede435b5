import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_options.discovery.ways import NEAR, PassingShare, loop_erased


def way_of(visits: list[int], features: list[float] | None = None, radius: float = 0.0) -> list[int]:
    points = np.array(range(max(visits) + 1) if features is None else features, dtype=float)[:, None]
    way: list[int] = loop_erased(points, np.array(visits), radius).tolist()
    return way


@pytest.mark.parametrize(
    ("visits", "expected"),
    [
        ([0], [0]),
        ([0, 1, 2], [0, 1, 2]),
        ([0, 1, 0, 1, 2], [0, 1, 2]),
        ([0, 1, 2, 1, 3], [0, 1, 3]),
        ([0, 1, 2, 3, 1, 0], [0, 1]),
        ([0, 0, 0, 1, 1], [0, 1]),
        ([0, 1, 0, 2, 0], [0, 2]),
        ([0, 0], [0]),
        ([0, 1, 2, 0, 0], [0, 1, 2]),
        ([0, 1, 2, 0, 3, 2, 4], [0, 3, 2, 4]),
    ],
)
def test_cuts_every_loop_out(visits: list[int], expected: list[int]) -> None:
    assert way_of(visits) == expected


@given(st.lists(st.integers(0, 6), min_size=1, max_size=60))
def test_is_a_walk_of_the_same_steps_without_repetition(places: list[int]) -> None:
    rows = {place: row for row, place in enumerate(dict.fromkeys(places))}
    visits = [rows[place] for place in places]
    way = way_of(visits)
    assert way[0] == visits[0]
    away = [visit for visit in visits if visit != visits[0]]
    assert way[-1] == visits[-1] or (visits[0] == visits[-1] and way[-1] == away[-1])
    assert len(set(way)) == len(way)
    assert set(itertools.pairwise(way)) <= set(itertools.pairwise(visits))


def test_states_within_the_radius_count_as_the_same() -> None:
    features = [0.0, 1.0, 2.0, 0.05, 3.0]
    assert way_of([0, 1, 2, 3, 4], features, radius=0.1) == [0, 4]
    assert way_of([0, 1, 2, 3, 4], features, radius=0.01) == [0, 1, 2, 3, 4]


def test_ends_within_the_radius_of_the_end() -> None:
    features = [0.0, 1.0, 2.0, 1.05]
    way = way_of([0, 1, 2, 3], features, radius=0.1)
    assert way == [0, 1]
    assert abs(features[way[-1]] - features[3]) <= 0.1


@pytest.mark.parametrize("step", [1.0, 0.3, 0.05])
def test_a_round_trip_keeps_its_way_however_small_its_steps(step: float) -> None:
    angles = np.arange(0.0, 2.0 * np.pi, step / 5.0)
    circle = 5.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    way = loop_erased(circle, np.r_[np.arange(len(circle)), 0], 0.5)
    assert np.linalg.norm(circle[way] - circle[0], axis=1).max() > 9.9
    assert 0.5 < np.linalg.norm(circle[way[-1]] - circle[0]) < 1.0 + 2 * step


X = np.arange(-5.0, 6.0)


def share_at(ways: list[Any], place: tuple[float, float]) -> float:
    """The share at a place, which is a way of its own that nobody else comes near but those who come near the place."""
    return float(PassingShare(0.5).update([*ways, np.array([place])])[-1])


def test_all_ways_pass_a_doorway_and_some_a_place_in_open_space() -> None:
    """Ten ways from left to right, a unit apart; or all through the origin."""
    open_space = [np.column_stack([X, np.full(11, height)]) for height in range(10)]
    doorway = [np.column_stack([X, np.abs(X) * height / 5]) for height in range(10)]
    assert share_at(open_space, (0.0, 5.0)) == pytest.approx((1 + 1) / (5 + 1 + 1))  # two of them are 3 away
    assert share_at(open_space, (0.0, 0.0)) == pytest.approx((1 + 1) / (3 + 1 + 1))
    assert share_at(doorway, (0.0, 0.0)) == pytest.approx((10 + 1) / (10 + 1 + 1))
    assert share_at(doorway, (40.0, 40.0)) == 1 / 2


def brute_force(ways: list[Any], radius: float) -> list[float]:
    shares: list[float] = []
    for way in ways:
        nearest = np.array([[np.linalg.norm(other - state, axis=1).min() for other in ways] for state in way])
        shares.extend(((nearest <= radius).sum(axis=1) / ((nearest <= NEAR * radius).sum(axis=1) + 1)).tolist())
    return shares


@pytest.mark.parametrize("decimals", [0, 8])
def test_counts_on_as_ways_come_and_go(rng: np.random.Generator, decimals: int) -> None:
    """Whether they share states or not."""
    ways = [rng.uniform(0, 10, (int(rng.integers(1, 9)), 2)).round(decimals) for _ in range(30)]
    shares = PassingShare(1.0)
    for first, last in [(0, 1), (0, 8), (3, 12), (2, 12), (20, 30), (29, 30), (0, 30)]:
        some = ways[first:last]
        assert shares.update(some).tolist() == brute_force(some, 1.0)
    assert shares.update(some[::-1]).tolist() == brute_force(some[::-1], 1.0)


def test_counts_in_parts_as_at_once(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    ways = [rng.uniform(0, 10, (int(rng.integers(1, 9)), 2)) for _ in range(20)]
    monkeypatch.setattr("sb3_options.discovery.ways.AT_ONCE", 64)
    assert PassingShare(1.0).update(ways).tolist() == brute_force(ways, 1.0)
