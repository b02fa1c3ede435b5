"""What would be dropped in silence is refused."""

from typing import Any

import numpy as np
import pytest

from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.density.log_density import log_diverse_density

MASKED = np.ma.array([[1.0], [2.0]], mask=[[False], [True]])


@pytest.mark.parametrize(
    ("bag", "said"),
    [
        (np.array([[1 + 2j]]), "positive bag 1 must hold real numbers, none of them masked, got complex128"),
        ([[1 + 2j]], "positive bag 1 must hold real numbers, none of them masked, got complex128"),
        (MASKED, "positive bag 1 must hold real numbers, none of them masked"),
        ([["1.5"]], "positive bag 1 must hold real numbers, none of them masked, got <U3"),
        ([[None]], "positive bag 1 must hold real numbers, none of them masked, got object"),
        ([[1.0], [1.0, 2.0]], "inhomogeneous shape"),
    ],
)
def test_no_real_numbers(bag: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Bags.pack([[[0.0]], bag])


def test_points_and_scales() -> None:
    bags = Bags.pack([[[0.0]]])
    with pytest.raises(ValueError, match="points must hold real numbers, none of them masked"):
        log_diverse_density(MASKED, 1.0, bags)
    with pytest.raises(ValueError, match="scale must be positive, finite, a number"):
        DiverseDensity(scale=1j)
