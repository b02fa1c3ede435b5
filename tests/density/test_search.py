import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike
from scipy.spatial.distance import pdist

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import HalfSpace, Point
from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.density.lbfgs import BatchedLBFGS, Objective
from sb3_options.density.regions import Region
from sb3_options.experience.observations import flatten
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.density.planted import planted, two_rooms
from tests.support.documents import ROOT, python_of

DENSITY_PAGE = ROOT / "docs" / "concepts" / "density.md"

FREE = (torch.tensor(-torch.inf), torch.tensor(torch.inf))


def rosenbrock(theta: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    x, y = theta
    value = (1 - x) ** 2 + 100 * (y - x * x) ** 2
    return value, torch.stack([-2 * (1 - x) - 400 * x * (y - x * x), 200 * (y - x * x)])


def descended(start: ArrayLike, steps: int, objective: Objective = rosenbrock, bounds: Any = FREE) -> BatchedLBFGS:
    descent = BatchedLBFGS(objective, torch.tensor(start, dtype=torch.float64), bounds, tolerance=1e-14)
    descent.run(steps)
    return descent


class TestBatchedLBFGS:
    def test_every_start_reaches_the_valley_floor(self) -> None:
        descent = descended([[-1.2, 0.0, 2.0, -3.0], [1.0, 0.0, -2.0, 5.0]], 300)
        assert descent.converged.all()
        torch.testing.assert_close(descent.theta, torch.ones_like(descent.theta), atol=1e-5, rtol=0)
        assert descent.evaluations < 120

    def test_bounds_hold_and_the_rest_is_minimised(self) -> None:
        bounds = torch.tensor([[-torch.inf], [-1.0]]), torch.tensor([[0.5], [torch.inf]])
        descent = descended([[0.0], [0.0]], 300, bounds=bounds)
        torch.testing.assert_close(descent.theta[:, 0], torch.tensor([0.5, 0.25]).double(), atol=1e-6, rtol=0)

    def test_narrowing_forgets_nothing(self) -> None:
        start = [[-1.2, 0.0, 2.0], [1.0, 0.0, -2.0]]
        whole, part = descended(start, 20), descended(start, 10)
        part.keep([2, 0], torch.float64)
        part.run(10)
        torch.testing.assert_close(part.theta, whole.theta[:, [2, 0]], rtol=1e-9, atol=1e-9)

    def test_too_few_steps_are_reported(self) -> None:
        assert not descended([[-1.2], [1.0]], 5).converged.any()

    def test_an_infinite_start_takes_any_step_down(self) -> None:
        def objective(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return torch.where(x[0] > 1, torch.inf, x[0] ** 2), 2 * x

        assert descended([[1.5]], 50, objective).value.item() < 1e-12


def slab(seed: int, n_negative: int = 0) -> Bags:
    """Bags that share their first coordinate, near 0, and nothing else."""
    rng = np.random.default_rng(seed)
    positive = [np.column_stack([rng.normal(0, 0.1, 8), rng.uniform(-20, 20, 8)]) for _ in range(10)]
    for bag in positive:
        bag[1:, 0] = rng.uniform(-20, 20, 7)
    away = [rng.uniform(2, 20, 30) * rng.choice([-1, 1], 30) for _ in range(n_negative)]
    return Bags.pack(positive, [np.column_stack([x, rng.uniform(-20, 20, 30)]) for x in away])


def test_a_planted_point_with_its_scale() -> None:
    for concept in (Point("fixed"), Point("one"), Point("each")):
        peaks = DiverseDensity(concept=concept, method="thorough").search(planted(0, 5))
        scales = np.log([peak.scale if concept.scales == "each" else peak.scale[:1] for peak in peaks])
        values = [peak.log_density for peak in peaks] - np.square(scales).sum(axis=1) / 2
        assert (np.diff(values) <= 1e-12).all()
        assert all(peak.converged for peak in peaks)
        region = peaks[0].region()
        assert np.linalg.norm(region.points[0] - [3, -2]) < 0.5
        assert region.contains(np.array([[3.0, -2.0], [9.0, 9.0]])).tolist() == [True, False]
        np.testing.assert_allclose(peaks[0].probability([[3.0, -2.0]]), 1, atol=0.3)
        thetas = np.column_stack([[peak.point * peak.scale for peak in peaks], np.exp(scales)])
        assert (pdist(thetas) > 0.5).all()


@pytest.mark.parametrize("seed", range(20))
def test_the_first_example_of_the_documents_finds_the_place(seed: int) -> None:
    """With other noise than the page's own, too. Its assertions are part of it."""
    example, seeds = re.subn(r"default_rng\(0\)", f"default_rng({seed})", python_of(DENSITY_PAGE)[0])
    assert seeds == 1
    assert example.count("assert ") >= 2
    exec(example, {})


def test_a_learned_scale_finds_the_feature_that_matters() -> None:
    best = DiverseDensity(concept=Point(prior_width=None), scale=0.5).search(slab(0, 4))[0]
    region = best.region()
    assert region.scale[0] > 5 * region.scale[1]
    inside = region.contains(np.array([[0.0, -4.0], [0.0, 4.0], [4.0, 0.0]]))
    assert inside.tolist() == [True, True, False]


@pytest.mark.parametrize("scales", ["one", "each"])
def test_without_negative_bags_the_widest_concept_explains_everything(scales: Literal["one", "each"]) -> None:
    without_bounds = Point(scales, scale_bounds=(0, np.inf), prior_width=None)
    concepts = without_bounds, Point(scales, scale_bounds=(0.5, 2.0), prior_width=None), Point(scales)
    free, bounded, default = (DiverseDensity(concept=concept).search(slab(1))[0] for concept in concepts)
    assert free.log_density == pytest.approx(0, abs=1e-6)
    assert free.region().scale[1] < 0.05
    assert bounded.region().scale[1] == pytest.approx(0.5)
    assert default.region().scale[1] > 0.1


def test_two_rooms_do_not_become_a_slab() -> None:
    # Every crossing passes every column, so that a slab, narrow along x and endless along y, explains all bags.
    unbounded = DiverseDensity(concept=Point(scale_bounds=(0, np.inf), prior_width=None)).search(two_rooms(0))
    assert unbounded[0].log_density == pytest.approx(0, abs=1e-6)
    assert unbounded[0].region().scale.min() < 0.3
    for seed in range(5):
        best = DiverseDensity(concept=Point()).search(two_rooms(seed))[0].region()
        assert np.abs(best.points[0] - [10, 5]).max() <= 1.5
        assert np.all(best.scale > 0.3)
        assert np.all(best.scale < 3)


def test_regions_are_level_sets() -> None:
    best = DiverseDensity(concept=Point()).search(planted(1, 5))[0]
    points = np.random.default_rng(0).uniform(-10, 10, size=(2000, 2))
    for level in (0.2, 0.8):
        np.testing.assert_array_equal(best.region(level).contains(points), best.probability(points) >= level)


def test_a_half_space() -> None:
    rng = np.random.default_rng(2)
    normal, scale = np.array([3.0, 4.0]) / 5, np.array([1.0, 0.1])

    def side(n: int, low: float, high: float) -> FloatArray:
        along, across = rng.uniform(low, high, n), rng.uniform(-5, 5, n)
        x, y = along * normal[0] - across * normal[1], along * normal[1] + across * normal[0]
        return np.asarray(np.column_stack([x, y]) / scale)

    positive = [np.vstack([side(4, -4, 1), side(1, 2.5, 5)]) for _ in range(20)]
    negative = [side(5, -4, 1) for _ in range(20)]
    best = DiverseDensity(concept=HalfSpace(), scale=scale).search(Bags.pack(positive, negative))[0]
    assert best.converged
    direction = best.scale / scale
    assert direction @ normal / np.linalg.norm(direction) > 0.98
    assert best.region().contains(side(500, 2.6, 5)).mean() > 0.98
    assert best.region().contains(side(500, -4, 0.9)).mean() < 0.02
    for level in (0.5, 0.9):
        assert best.probability(best.region(level).points)[0] == pytest.approx(level)


@pytest.mark.parametrize(
    "search",
    [DiverseDensity(concept=Point("one")), DiverseDensity(concept=Point("each")), DiverseDensity(concept=HalfSpace())],
)
def test_beta_tests_every_concept_before_and_after_a_file(search: DiverseDensity, tmp_path: Path) -> None:
    best = search.search(planted(2, 5))[0]
    nothing = TabularPolicy(np.zeros((1, 2)), np.zeros((1, 4)))
    everywhere = Region(np.zeros((1, 2)), np.zeros(2), 1.0)
    bank, again = (OptionBank(4, 2, feature_map=flatten, observation_size=2, feature_size=2) for _ in range(2))
    bank.add(SubgoalOption(best.region(), everywhere, nothing))
    bank.save(tmp_path / "options")
    again.load(tmp_path / "options")
    near = np.random.default_rng(0).uniform(-10, 10, size=(500, 2))
    points = np.concatenate([near, 50 * near])
    for option in (bank[0], again[0]):
        assert isinstance(option, SubgoalOption)
        np.testing.assert_array_equal(option.termination(points), best.probability(points) >= 0.5)
        assert 0 < option.termination(points).mean() < 1


def test_weak_negatives_tolerate_a_visit() -> None:
    rng = np.random.default_rng(3)
    positive = [np.vstack([rng.uniform(-10, 10, (10, 2)), [[3.0, -2.0]]]) for _ in range(15)]
    bags = Bags.pack(positive, [np.vstack([rng.uniform(-10, 10, (10, 2)), [[3.05, -2.0]]])])

    def distance(strength: float) -> float:
        best = DiverseDensity(method="thorough", negative_strength=strength).search(bags)[0]
        return float(np.linalg.norm(best.region().points[0] - [3, -2]))

    assert distance(0.1) < 0.05
    assert distance(1.0) > 0.2


@pytest.mark.parametrize("scales", ["fixed", "one"])
def test_no_rounding_decides_between_peaks_that_tie(scales: Literal["fixed", "one"]) -> None:
    """Two places that mirror each other explain the bags alike, in whatever order the instances come."""
    right = np.random.default_rng(11).normal([4, 0], 0.3, size=(20, 2))
    for seed in range(5):
        turn = 2 * np.pi * np.random.default_rng(seed).random()
        way = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        first, second = right @ way, (right * [-1, 1]) @ way
        found = []
        for one, other in ((first, second), (second, first)):
            bags = Bags.pack([np.stack(pair) for pair in zip(one, other, strict=True)])
            best, next_best = DiverseDensity(concept=Point(scales), method="thorough").search(bags)[:2]
            assert best.log_density == pytest.approx(next_best.log_density, abs=0.01)
            found.append(best.region().points[0])
        np.testing.assert_allclose(found[0], found[1], atol=0.01)
