"""Counts, random network distillation and the scale of bonuses, against what can be worked out by hand."""

from typing import Any, TypeVar

import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_options.experience.observations import flatten, stack
from sb3_options.learning import novelty

Networks = TypeVar("Networks", bound=novelty.NetworkNovelty)


def still(networks: Networks) -> Networks:
    """Keep the networks as they are."""
    networks._optimizer.param_groups[0]["lr"] = 0.0
    return networks


def visit(measure: novelty.StateCounts | novelty.RandomNetworkDistillation, arrived: Any) -> Any:
    """The bonuses of steps that arrive in these observations."""
    zeros = np.zeros(len(arrived), dtype=np.int64)
    return measure.bonuses(novelty.Steps(arrived, zeros, arrived, zeros, zeros == 1))


def test_one_over_the_root_of_visits() -> None:
    counts = novelty.StateCounts(flatten)
    np.testing.assert_allclose(visit(counts, np.array([3, 1, 3])), [1.0, 1.0, 2**-0.5])
    np.testing.assert_allclose(visit(counts, np.array([3])), [3**-0.5])
    assert counts.records() == {"states": 2.0}


def test_bins_are_around_whole_multiples() -> None:
    counts = novelty.StateCounts(flatten, 0.5)
    visit(counts, np.array([[1.0, 2.0], [1.24, 1.76], [1.26, 2.0]]))
    np.testing.assert_allclose(visit(counts, np.array([[1.1, 2.1], [1.5, 2.0], [2.0, 2.0]])), [3**-0.5, 2**-0.5, 1.0])
    assert len(counts.visits) == 3


@pytest.mark.parametrize(
    ("space", "table_like"),
    [
        (spaces.Discrete(4), True),
        (spaces.MultiDiscrete([2, 3]), True),
        (spaces.MultiBinary(3), True),
        (spaces.Box(0, 255, (40, 40, 3), np.uint8), True),
        (spaces.Dict({"a": spaces.Discrete(3), "b": spaces.Box(0, 9, (2,), np.int16)}), True),
        (spaces.Dict({"a": spaces.Discrete(3), "b": spaces.Box(0, 9, (2,))}), False),
        (spaces.Box(0.0, 1.0, (2,)), False),
    ],
)
def test_what_can_be_counted_as_it_is(space: Any, table_like: bool) -> None:
    assert novelty.is_table_like(space) is table_like
    if table_like:
        space.seed(0)
        one, other = space.sample(), space.sample()
        keys = novelty.StateCounts(flatten).keys(stack([one, other, one]))
        assert keys[0] == keys[2] != keys[1]
        assert max(map(len, keys)) <= 64


def test_the_error_falls_where_the_predictor_has_been() -> None:
    rng = np.random.default_rng(0)
    rnd = novelty.RandomNetworkDistillation(8)
    assert rnd.records() == {}
    known, new = np.eye(8)[rng.integers(4, size=(400, 16))], np.eye(8)[4:]
    first = visit(rnd, known[0])
    for batch in known[1:]:
        visit(rnd, batch)
    later = visit(rnd, np.eye(8)[:4])
    assert later.mean() < 0.1 * first.mean()
    assert rnd.records()["loss"] == pytest.approx(later.mean())
    assert later.max() < 0.1 * visit(rnd, new).min()


def test_the_error_is_of_normalised_and_clipped_features() -> None:
    rnd = still(novelty.RandomNetworkDistillation(2))
    seen = np.random.default_rng(0).normal([100.0, -3.0], [10.0, 0.1], size=(50, 2))
    row = np.array([[110.0, 7.0]])
    every = np.concatenate([seen, row])
    normalized = torch.tensor(np.clip((row - every.mean(axis=0)) / every.std(axis=0), -5, 5)).float()
    with torch.no_grad():
        error = (rnd.predictor(normalized) - rnd.target(normalized)).square().mean()
    visit(rnd, seen)
    np.testing.assert_allclose(visit(rnd, row), error, rtol=1e-3)


def test_networks_come_from_their_seed_and_draw_nothing_else() -> None:
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    one, same, other = (novelty.RandomNetworkDistillation(3, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(torch.rand(3), expected)
    rows = np.random.default_rng(0).normal(size=(4, 3))
    expected_errors = visit(one, rows)
    np.testing.assert_array_equal(expected_errors, visit(same, rows))
    assert (expected_errors != visit(other, rows)).all()


def test_the_return_goes_on_across_episodes_and_is_of_primitive_steps() -> None:
    rng = np.random.default_rng(0)
    runs = [[rng.random(int(rng.integers(1, 5))) for _ in range(2)] for _ in range(40)]
    scale = novelty.ReturnScale(0.9, 2)
    for step in runs:
        scale.update(step)
    returns = []
    for env in range(2):
        flat = np.concatenate([step[env] for step in runs])
        returns += [sum(0.9 ** (t - i) * flat[i] for i in range(t + 1)) for t in range(len(flat))]
    assert scale.std == pytest.approx(np.std(returns), rel=1e-3)


def test_bins_of_a_flat_observation_are_parts_of_its_range() -> None:
    box = spaces.Box(np.array([-1.2, -0.07, -np.inf, -3.4e38]), np.array([0.6, 0.07, np.inf, 3.4e38]), dtype=np.float64)
    np.testing.assert_allclose(novelty.bin_widths(box), [0.09, 0.007, 1.0, 1.0])


def test_features_that_cannot_be_counted_are_refused() -> None:
    with pytest.raises(ValueError, match="The feature map of the bonus gave NaN or infinite features"):
        visit(novelty.StateCounts(lambda x: np.full((len(x), 1), np.nan)), np.zeros((2, 3)))
