"""Value and gradient against 60 digits, where differences of large numbers decide."""

from collections.abc import Sequence
from typing import Any

import mpmath
import numpy as np
import pytest
import torch

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Point
from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.density.log_density import log_diverse_density
from tests.density.test_objective import evidence_of

mpf = mpmath.mpf


def exactly(
    a: FloatArray, s: FloatArray, positive: Sequence[FloatArray], negative: Sequence[FloatArray], eta: float = 1.0
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Value, gradient in a = s t and in s, and 1 − η p of every negative instance, with 60 digits until the end."""
    with mpmath.workdps(60):
        centre, scale = [mpf(v) for v in a.tolist()], [mpf(v) for v in s.tolist()]
        value, in_a, in_s, odds = mpf(0), [mpf(0)] * len(a), [mpf(0)] * len(a), []

        def difference(x: FloatArray) -> list[mpmath.mpf]:
            return [scale[k] * mpf(v) - centre[k] for k, v in enumerate(x.tolist())]

        def add(x: FloatArray, weight: mpmath.mpf) -> None:
            for k, part in enumerate(difference(x)):
                in_a[k] -= 2 * weight * part
                in_s[k] += 2 * weight * part * mpf(float(x[k]))

        def probability(x: FloatArray) -> mpmath.mpf:
            return mpmath.exp(-mpmath.fsum(part**2 for part in difference(x)))

        for bag in positive:
            p = [probability(x) for x in bag]
            miss = mpmath.fprod(1 - q for q in p)
            hit = 1 - miss if max(p) > 1e-30 else mpmath.fsum(p)
            value += mpmath.log(hit)
            for x, q in zip(bag, p, strict=True):
                add(x, -q / (1 - q) * miss / hit if q < 1 else mpf(0))
        for x in (x for bag in negative for x in bag):
            q = mpf(eta) * probability(x)
            odds.append(1 - q)
            value += mpmath.log(1 - q)
            add(x, q / (1 - q))
        by_a, by_s, left = (np.array([float(v) for v in part]) for part in (in_a, in_s, odds))
        return float(value), by_a, by_s, left


def bags_of(seed: int, scale: float = 1.0) -> tuple[list[FloatArray], list[FloatArray]]:
    rng = np.random.default_rng(seed)
    bags = [rng.normal(size=(4, 3)).astype(np.float32) / scale for _ in range(5)]
    return [b.astype(np.float64) for b in bags[:3]], [b.astype(np.float64) for b in bags[3:]]


def largest(error: FloatArray, of: FloatArray) -> float:
    return float(np.abs(error).max() / np.abs(of).max())


@pytest.mark.parametrize("eta", [1.0, 1 - 1e-15, 1 - 1e-9, 1 - 1e-6, 0.5])
@pytest.mark.parametrize("offset", [0.0, 128.0])
@pytest.mark.parametrize("distance", [0.1, 1e-3, 3e-5, 1e-6, 1e-8, 1e-10])
def test_near_a_negative_instance(distance: float, offset: float, eta: float) -> None:
    """As it was, the gradient in the scale lost all digits within 3e-5 widths, and the value 1e-8 of itself."""
    for seed in range(3):
        positive, negative = ([b + offset for b in bags] for bags in bags_of(seed))
        rng = np.random.default_rng(seed)
        s, way = rng.choice([0.5, 1.0, 2.0], size=3), rng.normal(size=3)  # powers of two: a is s t to the last bit
        t = negative[0][1] + distance * way / np.linalg.norm(s * way)
        value, in_a, in_s, _ = exactly(s * t, s, positive, negative, eta)
        in_t, in_scale = s * in_a, in_s + t * in_a  # of t and s, while a = s t
        points, scales = torch.tensor(t[None], requires_grad=True), torch.tensor(s[None], requires_grad=True)
        found = log_diverse_density(points, scales, Bags.pack(positive, negative), negative_strength=eta)
        by_point, by_scale = torch.autograd.grad(found, [points, scales])
        assert found.item() == pytest.approx(value, rel=1e-9)
        assert largest(by_point[0].numpy() - in_t, of=in_t) < 1e-9
        # The true gradient in s is what two sums leave of each other, which doubles cannot hold any better.
        assert np.abs(by_scale[0].numpy() - in_scale).max() < 1e-9 * np.abs(in_scale).max() + 1e-15 * np.abs(in_s).max()
        if offset:
            continue  # a search puts the origin into the middle of the data
        loss, slope = evidence_of(Bags.pack(positive, negative), eta=eta).loss(torch.tensor(np.r_[s * t, s])[:, None])
        rounding = 3e-8 + 1e-15 * max(1.0, float(np.linalg.norm(s * t))) / distance  # as `Evidence.loss` says
        assert -loss.item() == pytest.approx(value, rel=rounding)
        gradient = -slope[:, 0].numpy()
        assert largest(gradient[:3] - in_a, of=in_a) < rounding
        assert largest(gradient[3:] - in_s, of=in_s) < rounding


@pytest.mark.parametrize("eta", [1.0, 1 - 1e-15, 1 - 1e-9, 1 - 1e-6, 0.5])
def test_a_hit_on_a_negative_instance_pulls_nowhere(eta: float) -> None:
    positive, negative = bags_of(0)
    s, t = np.array([0.5, 1.0, 2.0]), negative[0][1]
    others = [np.delete(negative[0], 1, axis=0), negative[1]]
    _, in_a, in_s, _ = exactly(s * t, s, positive, others, eta)
    gradient = -evidence_of(Bags.pack(positive, negative), eta=eta).loss(torch.tensor(np.r_[s * t, s])[:, None])[1]
    np.testing.assert_allclose(gradient[:, 0], np.r_[in_a, in_s], rtol=1e-8)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 0.3, 1.0, 3.0, 1e3, 1e6])
def test_what_single_precision_is_worth(scale: float) -> None:
    """The bound that `Evidence.loss` states, of concepts from a millionth to a million times the width of the data."""
    for seed in range(20):
        positive, negative = bags_of(seed)
        rng = np.random.default_rng(seed)
        s = (scale * rng.uniform(0.5, 1.5, 3)).astype(np.float32).astype(np.float64)
        near = [*positive, *negative][seed % 5][0]
        a = ((near + rng.normal(size=3) / max(scale, 1)) * s).astype(np.float32).astype(np.float64)
        value, _, _, odds = exactly(a, s, positive, negative)
        found = -evidence_of(Bags.pack(positive, negative)).loss(torch.tensor(np.r_[a, s])[:, None].float())[0].item()
        reach = 1 + a @ a + max(float(np.square(s * x).sum()) for bag in (*positive, *negative) for x in bag)
        of_energies = 1e-6 * reach * (len(positive) + float(np.minimum(1 / odds, 1e6 * -np.log(odds)).sum()))
        assert abs(found - value) < of_energies + 1e-6
        assert found - value < -float(np.log(odds[odds < 1e-6]).sum()) - 13 * (odds < 1e-6).sum() + of_energies + 1e-6


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_units_of_the_features_change_nothing(scale: float) -> None:
    positive, negative = bags_of(1, scale)
    searches: list[dict[str, Any]] = [{"concept": Point()}, {"method": "thorough"}, {}]
    for settings in searches:
        best = DiverseDensity(**settings, scale=scale).search(Bags.pack(positive, negative))[0]
        expected = exactly(best.scale * best.point, best.scale, positive, negative)[0]
        assert best.log_density == pytest.approx(expected, rel=1e-9)
