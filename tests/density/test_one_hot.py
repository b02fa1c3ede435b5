"""The short cut for one-hot codes against the density of any features."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.density.one_hot import is_one_hot, one_hot_log_density

N_STATES = 6
CODES = np.eye(N_STATES)
BAGS = st.lists(st.lists(st.integers(0, N_STATES - 1), min_size=1, max_size=8), min_size=1, max_size=5)


@given(
    positive=BAGS,
    negative=st.one_of(st.just([]), BAGS),
    scale=st.floats(1e-3, 1e3),
    strength=st.sampled_from([1.0, 0.9, 0.5]),
    leak=st.sampled_from([0.0, 1e-9, 0.1, 0.9]),
)
def test_it_is_the_density_of_any_features(
    positive: list[list[int]], negative: list[list[int]], scale: float, strength: float, leak: float
) -> None:
    bags = Bags.pack([CODES[bag] for bag in positive], [CODES[bag] for bag in negative])
    engine = DiverseDensity(scale=scale, negative_strength=strength, leak=leak)
    expected = engine.log_density(CODES, bags)
    found = one_hot_log_density(CODES, scale, bags, strength, leak)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_far_states_have_a_density() -> None:
    """exp(−2 · 40²) is 0 in double precision, its logarithm is not."""
    bags = Bags.pack([CODES[[1, 2]]])
    assert one_hot_log_density(CODES[:2], 40.0, bags, 1.0, 0.0) == pytest.approx([math.log(2) - 3200, 0.0])


@pytest.mark.parametrize(
    ("scale", "points"), [(np.full(N_STATES, 2.0), CODES), (np.arange(1.0, N_STATES + 1), CODES), (1.0, CODES * 0.5)]
)
def test_it_is_not_taken_where_it_does_not_hold(scale: float | FloatArray, points: FloatArray) -> None:
    """With scales that differ, or candidates between states, the peaks are those of any features."""
    bags = Bags.pack([CODES[[0, 3]], CODES[[3, 4]]])
    engine = DiverseDensity(scale=scale, method="exhaustive")
    best = engine.search(bags, starts=points)[0]
    assert best.log_density == pytest.approx(engine.log_density(points, bags).max())


@pytest.mark.parametrize(
    ("features", "expected"),
    [
        (np.eye(3), True),
        (np.eye(2), True),
        (np.eye(3)[[0, 0]], True),
        (np.eye(3) * 2, False),
        (np.array([[0.0, 1.0], [1.0, 1.0]]), False),
        (np.array([[0.0, 0.0], [1.0, 0.0]]), False),
        (np.ones((3, 1)), False),
    ],
)
def test_codes_are_told_by_what_was_seen(features: FloatArray, expected: bool) -> None:
    assert is_one_hot(features) is expected
