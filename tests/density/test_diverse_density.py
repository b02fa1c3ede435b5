from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import MIN_EMIN, Decimal, localcontext
from typing import Literal

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike

from sb3_options.density import objective
from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity, Peak, log_diverse_density

# A bag's probability of a miss is rounded once, so a log density near 0 carries the rounding of 1.
ROUNDING = 1e-14


def oracle(
    point: ArrayLike,
    scale: ArrayLike,
    positive: Sequence[FloatArray],
    negative: Sequence[FloatArray] = (),
    strength: float = 1.0,
) -> Decimal:
    """Log diverse density by its definition, with as many digits as exp(−D) needs."""
    with localcontext() as context:
        context.prec, context.Emin = 60, MIN_EMIN
        t, s = (np.broadcast_to(np.asarray(v, float), np.shape(point)).tolist() for v in (point, scale))

        def p(instance: FloatArray) -> Decimal:
            terms = zip(t, s, instance.tolist(), strict=True)
            return (-sum(((Decimal(b) * (Decimal(x) - Decimal(a))) ** 2 for a, b, x in terms), Decimal(0))).exp()

        total = Decimal(0)
        for bag in positive:
            probabilities = [p(x) for x in bag]
            digits_lost = -max(probabilities).adjusted()
            if digits_lost > 1000:
                total += sum(probabilities, Decimal(0)).ln()  # the rest is smaller by a factor of 10^1000
                continue
            context.prec = 60 + digits_lost
            miss = Decimal(1)
            for probability in probabilities:
                miss *= 1 - probability
            hit = 1 - miss
            context.prec = 60
            total += (+hit).ln()
        for bag in negative:
            for x in bag:
                miss = 1 - Decimal(strength) * p(x)
                total += miss.ln() if miss else Decimal("-Infinity")
        return total


def random_bags(rng: np.random.Generator, n: int, d: int, spread: float) -> list[FloatArray]:
    return [rng.normal(scale=spread, size=(rng.integers(1, 6), d)) for _ in range(n)]


def density(
    points: ArrayLike,
    scale: ArrayLike,
    positive: Sequence[FloatArray],
    negative: Sequence[FloatArray] = (),
    eta: float = 1.0,
) -> FloatArray:
    value = log_diverse_density(points, scale, Bags.pack(positive, negative), negative_strength=eta)
    return np.asarray(value.numpy())


def test_value_against_the_definition() -> None:
    rng = np.random.default_rng(0)
    for case in range(500):
        d = int(rng.integers(1, 7))
        spread = 10.0 ** rng.uniform(-1, 1)
        positive = random_bags(rng, int(rng.integers(0, 4)), d, spread)
        negative = random_bags(rng, int(rng.integers(0 if positive else 1, 3)), d, spread)
        scale = rng.uniform(0.3, 2.0, size=d)
        eta = float(rng.choice([1.0, 0.5]))
        point = rng.normal(scale=spread, size=d)
        if positive and case % 5 == 0:
            point = positive[0][0]
        expected = float(oracle(point, scale, positive, negative, eta))
        assert density([point], scale, positive, negative, eta)[0] == pytest.approx(expected, rel=1e-9, abs=ROUNDING), (
            case
        )


@pytest.mark.parametrize("d", [2, 20])
@pytest.mark.parametrize("distance", [0.0, 1e-3, 0.1, 1.0, 3.0, 4.3, 4.4, 10.0, 27.0, 40.0, 100.0, 1e4])
def test_value_at_any_distance(distance: float, d: int) -> None:
    rng = np.random.default_rng(1)
    positive = [rng.normal(scale=0.1, size=(n, d)) + np.eye(d)[0] * distance for n in (3, 5)]
    positive[0][0] = np.eye(d)[0] * distance
    expected = oracle(np.zeros(d), 1.0, positive)
    assert density(np.zeros((1, d)), 1.0, positive)[0] == pytest.approx(float(expected), rel=1e-9, abs=ROUNDING)


def test_order_of_bags_and_instances_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    positive, negative, points = random_bags(rng, 5, 2, 2), random_bags(rng, 3, 2, 2), rng.normal(size=(7, 2))
    shuffled = [rng.permutation(bag) for bag in positive[::-1]], [rng.permutation(bag) for bag in negative[::-1]]
    np.testing.assert_allclose(density(points, 1.0, *shuffled), density(points, 1.0, positive, negative), rtol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_an_offset_costs_no_digits(dtype: torch.dtype) -> None:
    rng = np.random.default_rng(3)
    offset = np.array([1024.0, -4096.0])  # on the grid of the features, so that adding it is exact
    positive = [np.round(bag * 64) / 64 for bag in random_bags(rng, 5, 2, 2)]
    points = np.round(rng.normal(size=(7, 2)) * 64) / 64
    here = log_diverse_density(points, 1.0, Bags.pack(positive, dtype=dtype))
    there = log_diverse_density(points + offset, 1.0, Bags.pack([b + offset for b in positive], dtype=dtype))
    assert here.dtype == dtype
    torch.testing.assert_close(there, here, rtol=1e-14 if dtype == torch.float64 else 1e-7, atol=0)


def test_single_precision() -> None:
    rng = np.random.default_rng(4)
    positive, negative = random_bags(rng, 5, 2, 3), random_bags(rng, 3, 2, 3)
    points = np.concatenate([rng.normal(size=(20, 2)), [[1e4, 0.0]], positive[0]])
    single = log_diverse_density(points, 1.0, Bags.pack(positive, negative, dtype=torch.float32))
    np.testing.assert_allclose(single, density(points, 1.0, positive, negative), rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize(("n_positive", "n_negative"), [(3, 2), (3, 0), (0, 2), (1, 0)])
@pytest.mark.parametrize("eta", [1.0, 0.3])
@pytest.mark.parametrize("d", [1, 2, 6])
def test_gradient(n_positive: int, n_negative: int, eta: float, d: int) -> None:
    rng = np.random.default_rng(5)
    bags = Bags.pack(random_bags(rng, n_positive, d, 1.5), random_bags(rng, n_negative, d, 1.5))
    points = torch.tensor(rng.normal(scale=2, size=(4, d)), requires_grad=True)
    scales = torch.tensor(rng.uniform(0.5, 1.5, size=(4, d)), requires_grad=True)

    def f(t: torch.Tensor, s: torch.Tensor) -> torch.Tensor:
        return log_diverse_density(t, s, bags, negative_strength=eta)

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


@pytest.mark.parametrize("d", [1, 2, 6])
def test_gradient_with_a_leak(d: int) -> None:
    rng = np.random.default_rng(7)
    bags = Bags.pack(random_bags(rng, 3, d, 1.5), random_bags(rng, 2, d, 1.5), weights=[1, 2, 1, 1, 3])
    points = torch.tensor(rng.normal(scale=2, size=(4, d)), requires_grad=True)
    scales = torch.tensor(rng.uniform(0.5, 1.5, size=(4, d)), requires_grad=True)
    assert torch.autograd.gradcheck(lambda t, s: log_diverse_density(t, s, bags, leak=0.2), (points, scales))


@pytest.mark.parametrize("method", ["gradient", "exhaustive"])
def test_with_a_leak_the_place_of_most_bags_beats_the_middle(method: Literal["gradient", "exhaustive"]) -> None:
    most, few, between = [[0.0, 0.0]], [[6.0, 0.0]], [[3.0, 0.0]]
    bags = Bags.pack([np.array(most)] + [np.array(most + between)] * 5 + [np.array(few)] * 4)

    def best(leak: float) -> float:
        return float(DiverseDensity(method=method, leak=leak).search(bags)[0].point[0])

    assert 2.5 < best(0.0) < 4.5  # near all bags, and where few pass
    assert best(0.2) == pytest.approx(0.0, abs=0.1)


def test_with_a_leak_a_far_bag_costs_no_more_than_its_log() -> None:
    value = log_diverse_density([[0.0, 0.0]], 1.0, Bags.pack([ONE, ONE + 1e6]), leak=0.2)
    assert value.item() == pytest.approx(np.log(0.2))


def test_a_far_point_is_pulled_by_the_soft_max_of_the_bag() -> None:
    bag = np.array([[0.0, 0.0], [1e-4, 0.3], [-1e-4, -0.5]])
    t = torch.tensor([[1e4, 0.0]], dtype=torch.float64, requires_grad=True)
    value = log_diverse_density(t, 1.0, Bags.pack([bag]))
    value.backward()  # type: ignore[no-untyped-call]  # torch's
    difference = bag - [1e4, 0.0]
    weights = torch.softmax(torch.tensor(-np.square(difference).sum(1)), dim=0).numpy()
    assert value.item() == pytest.approx(float(oracle([1e4, 0.0], 1.0, [bag])), rel=1e-12)
    assert t.grad is not None
    np.testing.assert_allclose(t.grad[0], 2 * weights @ difference, rtol=1e-6)


def value_and_gradient(
    point: FloatArray, positive: Sequence[FloatArray], negative: Sequence[FloatArray] = ()
) -> tuple[float, FloatArray]:
    t = torch.tensor(point[None], requires_grad=True)
    s = torch.ones(1, len(point), dtype=torch.float64, requires_grad=True)
    value = log_diverse_density(t, s, Bags.pack(positive, negative))
    value.backward()  # type: ignore[no-untyped-call]  # torch's
    assert t.grad is not None
    assert s.grad is not None
    return value.item(), np.concatenate([t.grad[0].numpy(), s.grad[0].numpy()])


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


def test_saturation() -> None:
    bag = np.full((100, 2), 3.0)
    assert density([[3.0, 3.0]], 1.0, [bag] * 4).tolist() == [0.0]
    assert density([[3.0, 3.0]], 1.0, [], [bag]).tolist() == [-np.inf]
    near = [3.0, 3.1]
    assert density([near], 1.0, [], [bag])[0] == pytest.approx(float(oracle(near, 1.0, [], [bag])), rel=1e-12)
    value, gradient = value_and_gradient(np.array(near), [bag])
    assert value == pytest.approx(0.0, abs=ROUNDING)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-12)


def test_duplicates_count() -> None:
    instance = np.array([[1.0, 0.0]])
    once, twice = density([[0.0, 0.0]], 1.0, [instance])[0], density([[0.0, 0.0]], 1.0, [np.tile(instance, (2, 1))])[0]
    assert twice == pytest.approx(np.log1p(-((1 - np.exp(once)) ** 2)))


@pytest.mark.parametrize("lengths", [[1], [1, 1, 1], [1, 400, 3], [60] * 3, [33, 31, 35, 1000], [1000] + [2] * 50])
def test_uneven_bags(lengths: list[int]) -> None:
    rng = np.random.default_rng(8)
    positive = [rng.normal(scale=4, size=(n, 2)) for n in lengths]
    points = rng.normal(scale=6, size=(3, 2))
    separate = sum(density(points, 0.7, [bag]) for bag in positive)
    np.testing.assert_allclose(density(points, 0.7, positive), separate, rtol=1e-11, atol=ROUNDING)
    assert sum(len(segment.powers) for segment in Bags.pack(positive).segments) == sum(lengths)


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


def test_many_features_agree_with_few() -> None:
    rng = np.random.default_rng(10)
    positive, negative = random_bags(rng, 5, 2, 2), random_bags(rng, 2, 2, 2)
    points = np.concatenate([rng.normal(size=(9, 2)), positive[0], positive[1] + 1e-9])

    def widen(x: FloatArray) -> FloatArray:
        return np.hstack([x, np.full((len(x), 30), 50.0)])

    wide = density(widen(points), 1.0, [widen(b) for b in positive], [widen(b) for b in negative])
    np.testing.assert_allclose(wide, density(points, 1.0, positive, negative), rtol=1e-9, atol=ROUNDING)


START_RADIUS, GOAL_RADIUS, GOAL, DOOR = 2, 5, (20, 0), (10, 5)
MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1))


def two_room_bag(rng: np.random.Generator, drift: float) -> FloatArray:
    """First visits of a walk that steps towards door and goal with probability `drift`, filtered.

    The rooms are 21 × 10 cells, with a wall in column 10. Starts keep so far from the door that the filter does not.
    """
    start = cell = (int(rng.integers(7)), int(rng.integers(10)))
    path = [cell]
    while cell != GOAL:
        aim = DOOR if cell[0] < DOOR[0] else GOAL
        towards = [(int(np.sign(aim[0] - cell[0])), 0), (0, int(np.sign(aim[1] - cell[1])))]
        moves = [m for m in towards if m != (0, 0)] if rng.random() < drift else MOVES
        step = moves[rng.integers(len(moves))]
        new = (cell[0] + step[0], cell[1] + step[1])
        if 0 <= new[0] < 21 and 0 <= new[1] < 10 and (new[0] != DOOR[0] or new == DOOR):
            cell = new
        path.append(cell)

    def apart(a: tuple[int, int], b: tuple[int, int]) -> int:
        return abs(a[0] - b[0]) + abs(a[1] - b[1])

    kept = [c for c in dict.fromkeys(path) if apart(c, start) > START_RADIUS and apart(c, GOAL) > GOAL_RADIUS]
    return np.array(kept, dtype=np.float64)


def two_rooms(seed: int, drift: float = 0.15) -> Bags:
    rng = np.random.default_rng(seed)
    return Bags.pack([two_room_bag(rng, drift) for _ in range(25)])


def by_the_door(peak: Peak) -> bool:
    return bool(np.abs(np.round(peak.point) - DOOR).max() <= 1)


def test_two_rooms_best_peak_is_at_the_door() -> None:
    assert sum(by_the_door(DiverseDensity().search(two_rooms(seed))[0]) for seed in range(10)) >= 9


def test_two_rooms_door_ties_when_walks_are_aimless() -> None:
    exhaustive = DiverseDensity(method="exhaustive")
    assert sum(any(map(by_the_door, exhaustive.search(two_rooms(seed, 0.0)))) for seed in range(10)) >= 9


@pytest.mark.parametrize("drift", [0.0, 0.15])
def test_gradient_search_is_as_good_as_exhaustive(drift: float) -> None:
    for seed in range(10):
        bags = two_rooms(seed, drift)
        best = DiverseDensity(method="exhaustive").search(bags)[0].log_density
        assert DiverseDensity().search(bags)[0].log_density >= best - 1e-9


def planted(seed: int, n_negative: int = 0) -> Bags:
    """Uniform noise over a square, with one instance a bag around (3, −2)."""
    rng = np.random.default_rng(seed)
    positive = [np.vstack([rng.uniform(-10, 10, size=(20, 2)), rng.normal([3, -2], 0.3)]) for _ in range(15)]
    return Bags.pack(positive, [rng.uniform(-10, 10, size=(20, 2)) for _ in range(n_negative)])


@pytest.mark.parametrize("n_negative", [0, 3])
def test_peaks(n_negative: int) -> None:
    bags = planted(0, n_negative)
    search = DiverseDensity(steps=100, merge_radius=0.7)
    peaks = search.search(bags)
    values = [peak.log_density for peak in peaks]
    assert values == sorted(values, reverse=True)
    np.testing.assert_allclose(search.log_density([p.point for p in peaks], bags), values, rtol=1e-12)
    assert np.linalg.norm(peaks[0].point - [3, -2]) < 0.5
    assert peaks[0].converged
    for i, peak in enumerate(peaks):
        assert all(np.linalg.norm(peak.point - other.point) > 0.7 for other in peaks[:i])
    t = torch.tensor(peaks[0].point[None], requires_grad=True)
    log_diverse_density(t, 1.0, bags).backward()  # type: ignore[no-untyped-call]  # torch's
    assert t.grad is not None
    assert t.grad.abs().max() < 0.1


def test_no_peak_is_worse_than_the_best_start() -> None:
    for seed in range(5):
        bags = planted(seed, 2)
        best = DiverseDensity().log_density(bags.smallest_positive(3), bags).max()
        for steps in (1, 12):
            assert DiverseDensity(steps=steps).search(bags)[0].log_density >= best


def test_search_is_deterministic() -> None:
    first, second = (DiverseDensity().search(planted(1, 2)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.point, b.point)
        assert a.log_density == b.log_density


def test_warm_start_reaches_what_the_smallest_bag_misses() -> None:
    rng = np.random.default_rng(13)
    positive = [np.vstack([rng.uniform(-10, 10, size=(20, 2)), rng.normal([3, -2], 0.3)]) for _ in range(15)]
    bags = Bags.pack([np.array([[3.0, 3.0]]), *positive])
    search = DiverseDensity(n_smallest=1)
    cold, warm = search.search(bags), search.search(bags, starts=[[2.5, -1.5]])
    assert warm[0].log_density > cold[0].log_density + 1
    assert np.linalg.norm(warm[0].point - [3, -2]) < 1
    again = search.search(bags, starts=[peak.point for peak in warm])
    assert again[0].log_density >= warm[0].log_density


def test_starts_allow_a_search_without_positive_bags() -> None:
    peaks = DiverseDensity().search(Bags.pack([], [np.zeros((1, 2))]), starts=[[0.5, 0.0]])
    assert peaks[0].point[0] > 0.5
    assert peaks[0].log_density > DiverseDensity().log_density([[0.5, 0.0]], Bags.pack([], [np.zeros((1, 2))]))[0]


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
    given = DiverseDensity(method="exhaustive").search(bags, candidates=[[1.0, 1.0], [0.0, 9.0], [5.0, 5.0]])
    assert [peak.point.tolist() for peak in given] == [[1.0, 1.0], [5.0, 5.0]]
    assert len(DiverseDensity(method="exhaustive").search(bags, starts=[[0.0, 0.0]])) == 2


def test_gradient_search_returns_all_ties_too() -> None:
    shared = np.random.default_rng(14).permutation(30)[:20].astype(np.float64)[:, None] * 3
    bags = Bags.pack([np.vstack([shared, [[100.0 + i]]]) for i in range(4)])
    peaks = DiverseDensity().search(bags)
    assert [peak.point.tolist() for peak in peaks] == shared.tolist()
    assert {peak.log_density for peak in peaks} == {0.0}
    assert all(peak.converged for peak in peaks)


def test_one_hot_features() -> None:
    rng = np.random.default_rng(11)
    positive = [np.eye(60)[np.append(rng.choice(59, 15, replace=False), 59)] for _ in range(12)]
    for method in ("exhaustive", "gradient"):
        peak = DiverseDensity(method=method).search(Bags.pack(positive))[0]
        assert peak.point.argmax() == 59
        assert peak.log_density == 0.0


ONE = np.zeros((1, 2))


@pytest.mark.parametrize(
    ("positive", "negative", "text"),
    [
        ([], [], "there are no bags: pass at least one"),
        ([ONE, np.zeros((0, 2))], [], "positive bag 1 is empty, of shape (0, 2): leave empty bags out"),
        ([ONE], [[]], "negative bag 0 is empty"),
        ([[1.0, 2.0]], [], "positive bag 0 must have shape (instances, features), got (2,)"),
        ([ONE], [np.zeros((1, 3))], "negative bag 0 has 3 features, positive bag 0 has 2"),
        ([ONE, ONE * np.nan], [], "positive bag 1 holds NaN or infinite features"),
        ([ONE], [ONE + np.inf], "negative bag 0 holds NaN or infinite features"),
    ],
)
def test_bad_bags(positive: list[ArrayLike], negative: list[ArrayLike], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        Bags.pack(positive, negative)


def test_features_whose_squares_overflow() -> None:
    with pytest.raises(ValueError, match=re.escape("positive bag 1 holds features beyond ±1e+100")):
        Bags.pack([ONE, np.full((1, 2), -1e200)])
    far = Bags.pack([np.zeros((1, 2)), np.full((1, 2), 1e40)])
    with pytest.raises(ValueError, match=re.escape("features reach 5e+39 widths from their middle, at most 1e+15")):
        DiverseDensity().search(far)
    assert DiverseDensity(scale=1e-40).search(far)[0].log_density < 0


@pytest.mark.parametrize(
    ("points", "scales", "eta", "text"),
    [
        ([0.0, 0.0], 1.0, 1.0, "points must have shape (S, 2) as in the bags, got (2,)"),
        ([[0.0]], 1.0, 1.0, "points must have shape (S, 2) as in the bags, got (1, 1)"),
        ([[0.0, np.nan]], 1.0, 1.0, "one of the points holds NaN"),
        ([[0.0, 1e200]], 1.0, 1.0, "one of the points holds features beyond ±1e+100, whose squares overflow"),
        ([[0.0, 0.0]], [1.0, 1.0, 1.0], 1.0, "scales must be a number, (d,) or (S, d) = (1, 2), got (3,)"),
        ([[0.0, 0.0]], [1.0, 0.0], 1.0, "scales must be positive and finite"),
        ([[0.0, 0.0]], [1.0, 1e60], 1.0, "scales must be positive and finite"),
        ([[0.0, 0.0]], 1.0, 0.0, "negative_strength must lie in (0, 1], got 0.0"),
    ],
)
def test_bad_arguments(points: ArrayLike, scales: ArrayLike, eta: float, text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        log_diverse_density(points, scales, Bags.pack([ONE]), negative_strength=eta)


@pytest.mark.parametrize("leak", [-0.1, 1.0, np.nan])
def test_a_leak_out_of_range(leak: float) -> None:
    with pytest.raises(ValueError, match=re.escape("leak must lie in [0, 1), got")):
        log_diverse_density([[0.0, 0.0]], 1.0, Bags.pack([ONE]), leak=leak)
    with pytest.raises(ValueError, match=re.escape("leak must be in [0, 1), got")):
        DiverseDensity(leak=leak)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"scale": 0.0}, "scale must be positive, finite"),
        ({"scale": [[1.0]]}, "scale must be positive, finite, a number or (d,)"),
        ({"method": "newton"}, 'method must be "gradient" or "exhaustive", got \'newton\''),
        ({"n_starts": 0}, "n_starts must be a whole number of at least 1, got 0"),
        ({"n_smallest": 0}, "n_smallest must be a whole number of at least 1"),
        ({"steps": 0}, "steps must be a whole number of at least 1"),
        ({"steps": 2.5}, "steps must be a whole number of at least 1, got 2.5"),
        ({"n_starts": True}, "n_starts must be a whole number of at least 1, got True"),
        ({"merge_radius": -1.0}, "merge_radius must be at least 0, got -1.0"),
        ({"tolerance": float("nan")}, "tolerance must be at least 0, got nan"),
        ({"negative_strength": 2.0}, "negative_strength must be in (0, 1], got 2.0"),
    ],
)
def test_bad_settings(arguments: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        DiverseDensity(**arguments)  # type: ignore[arg-type]  # wrong on purpose


def test_bad_searches() -> None:
    gradient, exhaustive = DiverseDensity(), DiverseDensity(method="exhaustive")
    with pytest.raises(ValueError, match="pass starts to a gradient search"):
        gradient.search(Bags.pack([ONE]), candidates=ONE)
    with pytest.raises(ValueError, match="nothing to search from: without positive bags pass starts"):
        gradient.search(Bags.pack([], [ONE]))
    with pytest.raises(ValueError, match="nothing to search from: without positive bags pass candidates"):
        exhaustive.search(Bags.pack([], [ONE]))
    with pytest.raises(ValueError, match=re.escape("starts must be finite, of shape (m, 2), got (1, 3)")):
        gradient.search(Bags.pack([ONE]), starts=np.zeros((1, 3)))
    with pytest.raises(ValueError, match="candidates must be finite"):
        exhaustive.search(Bags.pack([ONE]), candidates=ONE * np.nan)
    with pytest.raises(ValueError, match=re.escape("scale has shape (3,), the bags have 2 features")):
        DiverseDensity(scale=[1.0, 1.0, 1.0]).search(Bags.pack([ONE]))
