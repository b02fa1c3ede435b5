"""Values and gradients of the log diverse density against its definition, near, far and on an instance."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from sb3_options.density import objective
from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.density.log_density import log_diverse_density
from tests.density.definition import ROUNDING, density, oracle, random_bags


def test_an_offset_costs_no_digits() -> None:
    rng = np.random.default_rng(3)
    offset = np.array([1024.0, -4096.0])  # on the grid of the features, so that adding it is exact
    positive = [np.round(bag * 64) / 64 for bag in random_bags(rng, 5, 2, 2)]
    points = np.round(rng.normal(size=(7, 2)) * 64) / 64
    here = log_diverse_density(points, 1.0, Bags.pack(positive))
    there = log_diverse_density(points + offset, 1.0, Bags.pack([b + offset for b in positive]))
    torch.testing.assert_close(there, here, rtol=1e-14, atol=0)


@pytest.mark.parametrize(("n_positive", "n_negative"), [(3, 2), (3, 0), (0, 2), (1, 0)])
@pytest.mark.parametrize(("eta", "leak"), [(1.0, 0.0), (0.3, 0.0), (1.0, 0.2)])
@pytest.mark.parametrize("d", [1, 2, 6])
def test_gradient(n_positive: int, n_negative: int, eta: float, leak: float, d: int) -> None:
    rng = np.random.default_rng(5)
    bags = Bags.pack(random_bags(rng, n_positive, d, 1.5), random_bags(rng, n_negative, d, 1.5))
    points = torch.tensor(rng.normal(scale=2, size=(4, d)), requires_grad=True)
    scales = torch.tensor(rng.uniform(0.5, 1.5, size=(4, d)), requires_grad=True)

    def f(t: torch.Tensor, s: torch.Tensor) -> torch.Tensor:
        return log_diverse_density(t, s, bags, negative_strength=eta, leak=leak)

    assert torch.autograd.gradcheck(f, (points, scales))
    assert torch.autograd.gradcheck(lambda s: f(points.detach(), s), (scales[0].detach().requires_grad_(),))


@pytest.mark.parametrize("leak", [1e-6, 0.2, 0.9])
@pytest.mark.parametrize("d", [2, 20])
def test_leaky_noisy_or_against_the_definition(leak: float, d: int) -> None:
    rng = np.random.default_rng(6)
    positive, negative = random_bags(rng, 5, d, 1.0), random_bags(rng, 2, d, 1.0)
    points = np.concatenate([rng.normal(size=(6, d)), positive[0], np.full((1, d), 1e3)])
    expected = density(points, 1.0, [], negative)
    for bag in positive:
        expected = expected + np.log(leak + (1 - leak) * np.exp(density(points, 1.0, [bag])))
    value = log_diverse_density(points, 1.0, Bags.pack(positive, negative), leak=leak)
    np.testing.assert_allclose(value, expected, rtol=1e-10, atol=ROUNDING)


def test_a_far_point_is_pulled_by_the_soft_max_of_the_bag() -> None:
    bag = np.array([[0.0, 0.0], [1e-4, 0.3], [-1e-4, -0.5]])
    value, gradient = value_and_gradient(np.array([1e4, 0.0]), [bag])
    difference = bag - [1e4, 0.0]
    weights = torch.softmax(torch.tensor(-np.square(difference).sum(1)), dim=0).numpy()
    assert value == pytest.approx(float(oracle([1e4, 0.0], 1.0, [bag])), rel=1e-12)
    np.testing.assert_allclose(gradient[:2], 2 * weights @ difference, rtol=1e-6)


def value_and_gradient(
    point: FloatArray, positive: Sequence[FloatArray], negative: Sequence[FloatArray] = ()
) -> tuple[float, FloatArray]:
    t = torch.tensor(point[None], requires_grad=True)
    s = torch.ones(1, len(point), dtype=torch.float64, requires_grad=True)
    value = log_diverse_density(t, s, Bags.pack(positive, negative))
    return value.item(), torch.cat(torch.autograd.grad(value, [t, s]), dim=1)[0].numpy()


@pytest.mark.parametrize("d", [2, 20])
def test_a_hit_on_a_positive_instance(d: int) -> None:
    rng = np.random.default_rng(6)
    bag = rng.normal(size=(5, d))
    value, gradient = value_and_gradient(bag[2], [bag])
    assert value == 0.0
    np.testing.assert_allclose(gradient, 0.0, atol=1e-12)
    others = [rng.normal(size=(3, d)) for _ in range(2)]
    _, with_hit = value_and_gradient(bag[2], [bag, *others])
    _, without = value_and_gradient(bag[2], others)
    np.testing.assert_allclose(with_hit, without, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("d", [2, 20])
def test_a_hit_on_a_negative_instance(d: int) -> None:
    rng = np.random.default_rng(7)
    positive, negative = [rng.normal(size=(3, d))], [rng.normal(size=(4, d))]
    value, gradient = value_and_gradient(negative[0][1], positive, negative)
    assert value == -np.inf
    _, without = value_and_gradient(negative[0][1], positive, [np.delete(negative[0], 1, axis=0)])
    np.testing.assert_allclose(gradient, without, rtol=1e-9, atol=1e-12)


def test_near_a_negative_instance_everything_is_finite() -> None:
    for distance in 10.0 ** -np.arange(1, 320, 3.0):
        value, gradient = value_and_gradient(np.array([distance, 0.0]), [np.ones((1, 2))], [np.zeros((1, 2))])
        assert np.isfinite(gradient).all()
        assert value < 0


@pytest.mark.parametrize("max_pairs", [1, 50, 333])
@pytest.mark.parametrize("d", [2, 20])
def test_chunks_change_nothing(max_pairs: int, d: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(9)
    positive, negative = random_bags(rng, 6, d, 1.0), random_bags(rng, 3, d, 1.0)
    points = np.concatenate([rng.normal(size=(30, d)), positive[0]])
    whole = density(points, 1.0, positive, negative)
    peaks = DiverseDensity().search(Bags.pack(positive, negative))
    monkeypatch.setattr(objective, "MAX_PAIRS", max_pairs)
    np.testing.assert_allclose(density(points, 1.0, positive, negative), whole, rtol=1e-12, atol=ROUNDING)
    for peak, same in zip(peaks, DiverseDensity().search(Bags.pack(positive, negative)), strict=True):
        np.testing.assert_allclose(peak.point, same.point, atol=1e-3)
