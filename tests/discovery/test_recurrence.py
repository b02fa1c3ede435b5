"""Discovery says once that nothing recurs, and what to do."""

import logging

import numpy as np
import pytest

from sb3_options.discovery.budget import seconds_of_look
from sb3_options.discovery.diary import Diary, any_recurs
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods.visits import RandomPlaces
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import Trajectory
from tests.discovery.lines import peaks_of


def trajectory(middle: np.ndarray, *, success: bool = True) -> tuple[Trajectory, np.ndarray]:
    """From 0 to 100 through places of its own."""
    states = np.concatenate([np.zeros((1, middle.shape[1])), middle, np.full((1, middle.shape[1]), 100.0)])
    visits, none = np.arange(len(states)), np.zeros(len(states) - 1)
    return Trajectory(states, visits, none.astype(np.int64), none, success, not success, success), states


def elsewhere(seed: int, d: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(1000.0, 2000.0, (6, d)) * (seed + 1)


@pytest.mark.parametrize("d", [2, 40])
def test_any_recurs(d: int) -> None:
    ways = [elsewhere(seed, d) for seed in range(5)]
    assert not any_recurs(ways, 1.5)
    assert not any_recurs([], 1.5)
    near = [*ways, ways[1][3:4] + 1.0 / np.sqrt(d)]
    assert any_recurs(near, 1.001)
    assert not any_recurs(near, 0.99)


def test_a_comparison_of_pictures_is_paid_for() -> None:
    rng = np.random.default_rng(0)
    ways = [rng.integers(0, 256, (100, 3 * 84 * 84)).astype(np.float64) for _ in range(6)]
    diary = Diary(radius=1.5)
    diary.compare_places(6, lambda: ways, "episodes")
    assert diary.nothing_recurs
    assert diary.spent == seconds_of_look(ways) == pytest.approx(600 * 6e-6 + 600 * 3 * 84 * 84 * 1e-9)
    diary.compare_places(12, lambda: [*ways, ways[2][50:51]], "episodes")
    assert diary.recurs
    assert diary.spent == seconds_of_look(ways)


def test_nothing_is_searched_until_something_recurs(caplog: pytest.LogCaptureFixture) -> None:
    discovery = Discovery(DiscoverySettings(min_passing=0.0, min_positive=4), kind="environment")
    with caplog.at_level(logging.WARNING, "sb3_options"):
        for seed in range(7):
            discovery.add(*trajectory(elsewhere(seed)))
            assert discovery.search() is None
    (record,) = caplog.records
    assert record.getMessage().startswith("Nothing can be discovered so far: nothing recurs. No two of 4 successful")
    assert "nothing recurs" in discovery.why_nothing()
    assert peaks_of(discovery).evidence is None
    discovery.add(*trajectory(elsewhere(3)))  # the eighth, when places are compared again
    discovery.search()
    assert discovery.diary.recurs
    assert peaks_of(discovery).evidence is not None


def test_a_method_goes_on_although_nothing_recurs(caplog: pytest.LogCaptureFixture) -> None:
    discovery = Discovery(DiscoverySettings(min_positive=4), RandomPlaces(min_successes=6), kind="given")
    found = []
    for seed in range(8):
        discovery.add(*trajectory(elsewhere(seed), success=seed != 1))
        found.append(discovery.search() is not None)
    assert any(found)
    assert caplog.text.count("nothing recurs. No two of 4 episodes came within") == 1
