"""Bags, points, settings and searches that are refused."""

import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Point
from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.density.log_density import log_diverse_density
from tests.density.definition import ONE

MASKED = np.ma.array([[1.0, 2.0]], mask=[[False, True]])


@pytest.mark.parametrize(
    ("positive", "negative", "text"),
    [
        ([], [], "there are no bags: pass at least one"),
        ([ONE, np.zeros((0, 2))], [], "positive bag 1 must have shape (instances, features), at least one of each"),
        ([ONE], [[]], "negative bag 0 must have shape (instances, features)"),
        ([[1.0, 2.0]], [], "positive bag 0 must have shape (instances, features)"),
        ([ONE], [np.zeros((1, 3))], "as many features as positive bag 0, (1, 2), got (1, 3)"),
        ([ONE, ONE * np.nan], [], "positive bag 1 holds NaN, or features beyond"),
        ([ONE, [[1 + 2j]]], [], "positive bag 1 must hold real numbers, none of them masked, got complex128"),
        ([ONE, MASKED], [], "positive bag 1 must hold real numbers, none of them masked"),
        ([[[None]]], [], "positive bag 0 must hold real numbers, none of them masked, got object"),
        ([[[1.0], [1.0, 2.0]]], [], "inhomogeneous shape"),
    ],
)
def test_bad_bags(positive: list[Any], negative: list[Any], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        Bags.pack(positive, negative)


def test_features_whose_squares_overflow() -> None:
    with pytest.raises(ValueError, match=re.escape("positive bag 1 holds NaN, or features beyond ±1e+100")):
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
        ([[0.0, 1e200]], 1.0, 1.0, "one of the points holds NaN, or features beyond ±1e+100"),
        ([[0.0, 0.0]], [1.0, 0.0], 1.0, "scales must be positive and finite"),
        ([[0.0, 0.0]], [1.0, 1e60], 1.0, "scales must be positive and finite"),
        ([[0.0, 0.0]], 1.0, 0.0, "negative_strength must be in (0, 1]"),
        (MASKED, 1.0, 1.0, "points must hold real numbers, none of them masked"),
    ],
)
def test_bad_arguments(points: ArrayLike, scales: ArrayLike, eta: float, text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        log_diverse_density(points, scales, Bags.pack([ONE]), negative_strength=eta)


@pytest.mark.parametrize("leak", [-0.1, 1.0, np.nan])
def test_a_leak_out_of_range(leak: float) -> None:
    with pytest.raises(ValueError, match=re.escape("leak in [0, 1)")):
        log_diverse_density([[0.0, 0.0]], 1.0, Bags.pack([ONE]), leak=leak)
    with pytest.raises(ValueError, match=r"^DiverseDensity: leak should be "):
        DiverseDensity(leak=leak)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"scale": -1.0}, "scale must be positive, finite, a number or (d,), got -1.0"),
        ({"scale": [[1.0]]}, "scale must be positive, finite, a number or (d,)"),
        ({"finalists": 0}, "finalists should be greater than or equal to 1, got 0"),
        ({"method": "newton"}, "method should be 'gradient', 'thorough' or 'exhaustive'"),
        ({"negative_strength": 2.0}, "negative_strength should be less than or equal to 1, got 2.0"),
        ({"concept": Point(), "method": "exhaustive"}, "needs method=\"thorough\", got 'exhaustive'"),
    ],
)
def test_bad_settings(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        DiverseDensity(**arguments)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"scales": "two"}, "scales should be 'each', 'one' or 'fixed'"),
        ({"scale_bounds": (1.0, 0.5)}, "scale_bounds must be factors 0 <= low < high, got (1.0, 0.5)"),
        ({"prior_width": 0.0}, "prior_width should be greater than 0, got 0.0"),
    ],
)
def test_bad_concepts(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        Point(**arguments)


def test_bad_searches() -> None:
    gradient, exhaustive = DiverseDensity(), DiverseDensity(method="exhaustive")
    for search in (gradient, exhaustive):
        with pytest.raises(ValueError, match="nothing to search from: without positive bags pass starts"):
            search.search(Bags.pack([], [ONE]))
    with pytest.raises(ValueError, match=re.escape("starts must be finite, of shape (m, 2), got (1, 3)")):
        gradient.search(Bags.pack([ONE]), starts=np.zeros((1, 3)))
    with pytest.raises(ValueError, match="starts must be finite"):
        exhaustive.search(Bags.pack([ONE]), starts=ONE * np.nan)
    with pytest.raises(ValueError, match="could not be broadcast"):
        DiverseDensity(scale=[1.0, 1.0, 1.0]).search(Bags.pack([ONE]))
