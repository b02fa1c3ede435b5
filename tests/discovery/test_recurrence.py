"""Discovery says once that nothing recurs, and what to do."""

import logging

import numpy as np
import pytest

from sb3_options.discovery.methods.visits import RandomPlaces
from sb3_options.discovery.proposed import discovery_with
from sb3_options.discovery.recurrence import Recurrence, recurs
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import Trajectory


def trajectory(middle: np.ndarray, *, success: bool = True) -> tuple[Trajectory, np.ndarray]:
    """From 0 to 100 through places of its own."""
    states = np.concatenate([np.zeros((1, middle.shape[1])), middle, np.full((1, middle.shape[1]), 100.0)])
    visits, none = np.arange(len(states)), np.zeros(len(states) - 1)
    return Trajectory(states, visits, none.astype(np.int64), none, success, not success, success), states


def elsewhere(seed: int, d: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(1000.0, 2000.0, (6, d)) * (seed + 1)


@pytest.mark.parametrize("d", [2, 40])
def test_recurs(d: int) -> None:
    ways = [elsewhere(seed, d) for seed in range(5)]
    assert not recurs(ways, 1.5)
    assert not recurs([], 1.5)
    near = [*ways, ways[1][3:4] + 1.0 / np.sqrt(d)]
    assert recurs(near, 1.001)
    assert not recurs(near, 0.99)


def test_a_look_at_large_pictures_is_quick_and_is_charged() -> None:
    rng = np.random.default_rng(0)
    ways = [rng.integers(0, 256, (100, 3 * 84 * 84)).astype(np.float64) for _ in range(6)]
    assert not recurs(ways, 1.5)
    assert recurs([*ways, ways[2][50:51]], 1.5)
    recurrence = Recurrence(2, 1.5)
    assert recurrence.look(ways, 6, "episodes") == pytest.approx(600 * 6e-6 + 600 * 3 * 84 * 84 * 1e-9)
    assert Recurrence(2, 1.5).look([*ways, ways[2]], 7, "episodes") == 0.0


def test_it_says_so_once_and_searches_no_more(caplog: pytest.LogCaptureFixture) -> None:
    discovery = discovery_with(DiscoverySettings(min_passing=0.0, min_positive=4), kind="environment")
    with caplog.at_level(logging.WARNING):
        for seed in range(40):
            discovery.add(*trajectory(elsewhere(seed)))
            assert discovery.search() is None
    (said,) = [record.getMessage() for record in caplog.records]
    assert said.startswith(
        "Nothing can be discovered so far: nothing recurs. No two of 4 successful episodes came within 1.5 units of "
        "the same place, apart from where they began and ended, in a concept space of 3 features."
    )
    for remedy in ("feature_map=", "DiscoverySettings(scale=", "success="):
        assert remedy in said
    assert discovery.last.bags is None
    assert "nothing recurs. No two of 40 successful episodes" in discovery.why_nothing()


def test_it_looks_again_when_there_are_twice_as_many() -> None:
    discovery = discovery_with(DiscoverySettings(min_passing=0.0, min_positive=4), kind="environment")
    searched = []
    for seed in range(20):
        middle = elsewhere(seed)
        if seed >= 5:
            middle[2] = 500.0  # from now on all have this place in common
        discovery.add(*trajectory(middle))
        discovery.search()
        searched.append(discovery.last.bags is not None)
    assert searched == [False] * 7 + [True] * 13


def test_methods_are_told_all_the_same(caplog: pytest.LogCaptureFixture) -> None:
    discovery = discovery_with(DiscoverySettings(min_positive=4), method=RandomPlaces(min_successes=6), kind="given")
    with caplog.at_level(logging.WARNING):
        found = []
        for seed in range(12):
            discovery.add(*trajectory(elsewhere(seed)))
            found.append(discovery.search() is not None)
    (said,) = [record.getMessage() for record in caplog.records]
    assert "No two of 4 episodes came within" in said
    assert found == [False] * 5 + [True] * 7


def test_its_state() -> None:
    recurrence, other = Recurrence(2, 1.5), Recurrence(2, 1.5)
    recurrence.look([elsewhere(0), elsewhere(1)], 2, "episodes")
    assert recurrence.nothing
    other.set_state(recurrence.get_state())
    assert other.nothing
    assert [other.is_due(n) for n in (3, 4)] == [False, True]
    other.look([elsewhere(0), elsewhere(0)], 4, "episodes")
    assert not other.nothing
    assert not other.is_due(100)
