import numpy as np

from experiments.common import curves


def test_ratios_and_windows() -> None:
    theirs = np.array([2.0, 4.0, 6.0])
    assert curves.ratio_interval(theirs / 2, theirs) == (0.5, 0.5, 0.5)
    interval = curves.ratio_interval(np.array([1.0, 3.0, 2.0]), theirs)
    assert interval.low < interval.mean == 0.5 < interval.high
    steps = np.arange(12.0).reshape(2, 6)
    assert curves.window(steps, 2, 3).tolist() == [2.5, 8.5]
    assert curves.window(steps, 50, 60).tolist() == [5.0, 11.0]
