import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Concept, HalfSpace, Point
from sb3_options.density.energies import Likelihood
from sb3_options.density.evidence import Evidence
from sb3_options.density.log_density import log_diverse_density
from tests.density.definition import ROUNDING, density, oracle, random_bags

FLAT = HalfSpace(steepness=1e9, offset=1e9)
"""With a prior that says nothing."""


def evidence_of(bags: Bags, concept: Concept | None = None, eta: float = 1.0, leak: float = 0.0) -> Evidence:
    d, likelihood = bags.n_features, Likelihood(eta, leak, isinstance(concept, HalfSpace))
    return Evidence(bags, concept or Point(prior_width=None), np.zeros(d), np.ones(d), likelihood)


def theta_of(points: FloatArray, scales: FloatArray) -> Tensor:
    """θ of `Point` with a scale per feature, (2 d, S)."""
    return torch.from_numpy(np.concatenate([(points * scales).T, np.broadcast_to(scales, points.shape).T]))


def densities(
    evidence: Evidence, points: FloatArray, scales: FloatArray, dtype: torch.dtype = torch.float64
) -> FloatArray:
    return -evidence.loss(theta_of(points, scales).to(dtype))[0].double().numpy()


# Relative and absolute error that each precision is held to. Single precision cancels near negative instances; what
# a search returns is computed in double precision.
PRECISIONS = {torch.float64: (1e-9, 1e-12), torch.float32: (2e-3, 2e-3)}


def check_value(
    point: FloatArray,
    scale: FloatArray,
    positive: list[FloatArray],
    negative: list[FloatArray],
    eta: float = 1.0,
    *,
    single: bool = True,
) -> None:
    """`log_diverse_density` and searches in both precisions, or only in double precision, against the definition."""
    expected = float(oracle(point, scale, positive, negative, eta))
    assert density([point], scale, positive, negative, eta)[0] == pytest.approx(expected, rel=1e-9, abs=ROUNDING)
    for dtype, (rel, absolute) in PRECISIONS.items():
        if single or dtype == torch.float64:
            value = densities(evidence_of(Bags.pack(positive, negative), eta=eta), point[None], scale, dtype)[0]
            assert value == pytest.approx(expected, rel=rel, abs=absolute), dtype


def test_value_against_the_definition() -> None:
    rng = np.random.default_rng(0)
    for case in range(300):
        d = int(rng.integers(1, 7))
        spread = 10.0 ** rng.uniform(-1, 1)
        positive = random_bags(rng, int(rng.integers(0, 4)), d, spread)
        negative = random_bags(rng, int(rng.integers(0 if positive else 1, 3)), d, spread)
        scale, eta = rng.uniform(0.3, 2.0, size=d), float(rng.choice([1.0, 0.5]))
        point = rng.normal(scale=spread, size=d)
        if positive and case % 5 == 0:
            point = positive[0][0]
        check_value(point, scale, positive, negative, eta, single=spread < 5)


@pytest.mark.parametrize("d", [2, 20])
@pytest.mark.parametrize("distance", [0.0, 1e-3, 0.1, 1.0, 3.0, 4.3, 4.4, 10.0, 27.0, 40.0, 100.0, 1e4])
def test_value_at_any_distance(distance: float, d: int) -> None:
    rng = np.random.default_rng(1)
    positive = [rng.normal(scale=0.1, size=(n, d)) + np.eye(d)[0] * distance for n in (3, 5)]
    positive[0][0] = np.eye(d)[0] * distance
    check_value(np.zeros(d), np.ones(d), positive, [])


def by_autograd(theta: Tensor, bags: Bags) -> tuple[Tensor, Tensor]:
    """The same concepts through `log_diverse_density`, whose gradient is checked against finite differences."""
    theta = theta.clone().requires_grad_()
    a, s = theta.chunk(2)
    value = log_diverse_density((a / s).T, s.T, bags)
    return value.detach(), torch.autograd.grad(value.sum(), theta)[0]


@pytest.mark.parametrize("reach", [1.0, 4.0, 40.0, 1e4])
@pytest.mark.parametrize(("n_positive", "n_negative"), [(3, 2), (3, 0), (0, 2), (1, 0)])
@pytest.mark.parametrize("d", [1, 2, 6])
def test_gradient(n_positive: int, n_negative: int, d: int, reach: float) -> None:
    rng = np.random.default_rng(5)
    bags = Bags.pack(random_bags(rng, n_positive, d, 1.5), random_bags(rng, n_negative, d, 1.5))
    theta = theta_of(rng.normal(scale=reach, size=(4, d)), rng.uniform(0.5, 1.5, size=(4, d)))
    loss, gradient = evidence_of(bags).loss(theta)
    expected, slope = by_autograd(theta, bags)
    torch.testing.assert_close(-loss, expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(-gradient, slope, rtol=1e-7, atol=1e-8 * reach)
    single = evidence_of(bags).loss(theta.float())[1]
    torch.testing.assert_close(-single.double(), slope, rtol=2e-3, atol=2e-3 * reach)


def check_gradient(evidence: Evidence, theta: Tensor) -> None:
    """The gradient against central differences of the value."""
    _, gradient = evidence.loss(theta)
    for k in range(len(theta)):
        step = torch.zeros_like(theta)
        step[k] = 1e-6
        slope = (evidence.loss(theta + step)[0] - evidence.loss(theta - step)[0]) / 2e-6
        torch.testing.assert_close(gradient[k], slope, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "concept", [Point(), Point("one"), Point("fixed"), Point(prior_width=None), Point(prior_width=0.5), HalfSpace()]
)
@pytest.mark.parametrize("eta", [1.0, 0.3])
def test_gradient_of_every_concept(concept: Concept, eta: float) -> None:
    rng = np.random.default_rng(6)
    bags = Bags.pack(random_bags(rng, 4, 3, 1.5), random_bags(rng, 3, 3, 1.5))
    evidence = evidence_of(bags, concept, eta)
    theta = concept.start(torch.from_numpy(rng.normal(size=(5, 3))), 0.7)
    check_gradient(evidence, theta + torch.from_numpy(0.1 * rng.normal(size=theta.shape)))


@pytest.mark.parametrize("concept", [Point(prior_width=None), Point("fixed"), FLAT])
@pytest.mark.parametrize("reach", [1.0, 40.0, 1e3])  # bags that are too far to be quick
def test_gradient_with_a_leak(concept: Concept, reach: float) -> None:
    rng = np.random.default_rng(12)
    bags = Bags.pack(random_bags(rng, 4, 3, 1.5), random_bags(rng, 3, 3, 1.5))
    evidence = evidence_of(bags, concept, eta=0.3, leak=0.2)
    theta = concept.start(torch.from_numpy(rng.normal(scale=reach, size=(5, 3))), 0.7)
    check_gradient(evidence, theta)
    if concept is not FLAT:  # whose weak negatives have weak odds, and no least probability
        assert (-evidence.loss(theta)[0] >= math.log(0.2) * len(bags.lengths) - 10).all()


@pytest.mark.parametrize(("reach", "eta"), [(1.0, 1.0), (300.0, 1.0), (1.0, 0.2)])
def test_a_half_space_at_any_distance(reach: float, eta: float) -> None:
    rng = np.random.default_rng(7)
    positive, negative = random_bags(rng, 3, 2, 1.0), random_bags(rng, 2, 2, 1.0)
    theta = torch.from_numpy(np.array([[1.0], [2.0], [reach]]))
    evidence = evidence_of(Bags.pack(positive, negative), FLAT, eta)

    def log_p(x: FloatArray, eta: float = 1.0) -> FloatArray:
        return np.asarray(-np.logaddexp(0, reach - x @ [1.0, 2.0] - math.log(eta)))

    expected = sum(
        math.log(-math.expm1(np.log1p(-np.exp(log_p(b))).sum())) if reach < 100 else np.logaddexp.reduce(log_p(b))
        for b in positive
    ) + sum(float(np.log1p(-np.exp(log_p(b, eta))).sum()) for b in negative)
    assert -evidence.loss(theta)[0].item() == pytest.approx(expected, rel=1e-6)
    check_gradient(evidence, theta)


def test_one_leak_in_every_precision_and_way() -> None:
    rng = np.random.default_rng(13)
    bags = Bags.pack(random_bags(rng, 5, 2, 2.0), random_bags(rng, 2, 2, 2.0))
    points = np.concatenate([rng.normal(scale=3, size=(8, 2)), bags.instances[:2].numpy(), [[1e3, 0.0]]])
    expected = log_diverse_density(points, 1.0, bags, negative_strength=0.5, leak=0.2).numpy()
    evidence = evidence_of(bags, eta=0.5, leak=0.2)
    theta = theta_of(points, np.ones(2))
    for value in (evidence.value(theta), evidence.value(theta.float()), evidence.loss(theta)[0]):
        np.testing.assert_allclose(-value.double().numpy(), expected, rtol=1e-4, atol=1e-5)


def test_saturation() -> None:
    bag = np.full((100, 2), 3.0)
    for dtype in (torch.float64, torch.float32):
        hit = densities(evidence_of(Bags.pack([bag] * 4)), np.array([[3.0, 3.0]]), np.ones(2), dtype)
        assert hit[0] == pytest.approx(0, abs=1e-12)
        near = densities(evidence_of(Bags.pack([], [bag])), np.array([[3.0, 3.1]]), np.ones(2), dtype)
        assert near[0] == pytest.approx(float(oracle([3.0, 3.1], 1.0, [], [bag])), rel=1e-3)
        on_it = evidence_of(Bags.pack([], [bag])).loss(theta_of(np.array([[3.0, 3.0]]), np.ones(2)).to(dtype))
        assert on_it[0].item() == np.inf if dtype == torch.float64 else on_it[0].item() > 1000
        assert on_it[1].isfinite().all()


@pytest.mark.parametrize(
    "lengths", [[1], [1, 1, 1], [1, 400, 3], [60] * 3, [33, 31, 35, 1000], [1000] + [2] * 50, [20_000, 3, 9_000]]
)
def test_uneven_bags_waste_nothing(lengths: list[int]) -> None:
    rng = np.random.default_rng(8)
    bags = [rng.normal(scale=4, size=(n, 2)) for n in lengths]
    points, scales = rng.normal(scale=3, size=(3, 2)), np.full(2, 0.7)
    for positive, negative in ((bags, []), ([], bags)):
        separate = sum(
            densities(evidence_of(Bags.pack([b] if positive else [], [b] if negative else [])), points, scales)
            for b in bags
        )
        evidence = evidence_of(Bags.pack(positive, negative))
        np.testing.assert_allclose(densities(evidence, points, scales), separate, rtol=1e-10, atol=1e-12)
        assert sum(len(s.powers) for s in evidence.segments(torch.float64)) == sum(lengths)


FEATURE = st.floats(-30, 30, width=32)
SOME_BAGS = st.lists(arrays(np.float64, st.tuples(st.integers(1, 5), st.just(2)), elements=FEATURE), max_size=4)


@given(positive=SOME_BAGS, negative=SOME_BAGS, point=st.tuples(FEATURE, FEATURE), offset=FEATURE)
@settings(max_examples=50)
def test_order_and_origin_change_nothing(
    positive: list[FloatArray], negative: list[FloatArray], point: tuple[float, float], offset: float
) -> None:
    assume(positive or negative)
    at, ones = np.array([point]), np.ones(2)
    before = densities(evidence_of(Bags.pack(positive, negative)), at, ones)
    assume(np.isfinite(before).all())
    reversed_bags = Bags.pack([bag[::-1] for bag in positive[::-1]], [bag[::-1] for bag in negative[::-1]])
    np.testing.assert_allclose(densities(evidence_of(reversed_bags), at, ones), before, rtol=1e-9, atol=1e-9)
    moved = Bags.pack([bag + offset for bag in positive], [bag + offset for bag in negative])
    near = [b for b in negative if np.linalg.norm(b - at, axis=1).min() < 1e-3]
    if not near:  # there 1 − p magnifies the rounding of the move
        np.testing.assert_allclose(densities(evidence_of(moved), at + offset, ones), before, rtol=1e-6, atol=1e-6)
    assert before[0] <= 0
    more = densities(evidence_of(Bags.pack([*positive, np.vstack([*positive, at])], negative)), at, ones)
    np.testing.assert_allclose(more, before, rtol=1e-9, atol=1e-9)
