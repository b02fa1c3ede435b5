import numpy as np

from experiments.common import curves


def test_windows() -> None:
    steps = np.arange(12.0).reshape(2, 6)
    assert curves.window(steps, 2, 3).tolist() == [2.5, 8.5]
    assert curves.window(steps, 50, 60).tolist() == [5.0, 11.0]
