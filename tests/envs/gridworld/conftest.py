from collections.abc import Iterator

import matplotlib.pyplot as plt
import pytest


@pytest.fixture(autouse=True)
def no_display() -> Iterator[None]:
    """Matplotlib's backend without windows, for "human" too; it warns where there is a display."""
    plt.switch_backend("agg")
    yield
    plt.close("all")
