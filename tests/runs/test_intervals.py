import numpy as np
import pytest

from experiments.common.intervals import iqm_ratio, ratio_interval
from sb3_options.runs.intervals import Interval, band, iqm, mean_interval, probability_of_improvement, share_interval


class TestIntervals:
    def test_of_a_mean_cover_it_about_as_often_as_they_say(self) -> None:
        rng = np.random.default_rng(0)
        intervals = [mean_interval(rng.normal(3.0, 2.0, size=40)) for _ in range(60)]
        assert all(i.low < i.mean < i.high for i in intervals)
        covered = np.mean([i.low <= 3.0 <= i.high for i in intervals])
        assert covered >= 0.85
        width = np.mean([i.high - i.low for i in intervals])
        assert width == pytest.approx(2 * 1.96 * 2.0 / np.sqrt(40), rel=0.1)

    def test_of_equal_values_are_points(self) -> None:
        assert mean_interval(np.array([2.0, 2.0, 2.0])) == mean_interval(np.array([2.0])) == Interval(2.0, 2.0, 2.0)

    def test_of_a_share_are_wilsons(self) -> None:
        # Wilson (1927): (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n)
        z, n, p = 1.959964, 20, 0.9
        centre, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        expected = np.array([p, *((centre + s * half) / (1 + z * z / n) for s in (-1, 1))])
        np.testing.assert_allclose(share_interval(18, 20), expected, atol=1e-6)
        assert share_interval(20, 20).high == pytest.approx(1.0)
        assert share_interval(20, 20).low < 0.9

    def test_of_a_ratio_are_over_pairs(self) -> None:
        theirs = np.array([2.0, 4.0, 6.0])
        assert ratio_interval(theirs / 2, theirs) == (0.5, 0.5, 0.5)
        interval = ratio_interval(np.array([1.0, 3.0, 2.0]), theirs)
        assert interval.low < interval.mean == 0.5 < interval.high


def test_interquartile_mean() -> None:
    assert iqm(np.array([100.0, 2.0, 3.0, 4.0, 5.0, -50.0, 3.0, 4.0])) == pytest.approx((3 + 4 + 3 + 4) / 4)


def test_ratio_of_interquartile_means() -> None:
    ratio = iqm_ratio(np.full(8, 3.0), np.full(8, 6.0))
    assert ratio == (0.5, 0.5, 0.5)
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(5.0, 1.0, 20), rng.normal(10.0, 1.0, 20)
    noisy = iqm_ratio(ours, theirs)
    assert noisy.low < noisy.mean < noisy.high
    assert noisy.low > 0.4
    assert noisy.high < 0.6


def test_pairs_of_unequal_difficulty_have_a_narrow_ratio() -> None:
    theirs = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0])
    paired, apart = iqm_ratio(0.5 * theirs, theirs, paired=True), iqm_ratio(0.5 * theirs, theirs)
    assert paired == pytest.approx((0.5, 0.5, 0.5))
    assert apart.high - apart.low > 0.5


def test_probability_of_improvement_counts_ties_half() -> None:
    assert probability_of_improvement(np.array([1.0, 2.0]), np.array([2.0, 3.0])).mean == pytest.approx(3.5 / 4)


def test_a_band_encloses_the_interquartile_mean_of_each_point() -> None:
    curves = np.stack([np.array([0.0, float(i)]) for i in range(8)])
    middle, low, high = band(curves)
    assert (middle[0], low[0], high[0]) == (0.0, 0.0, 0.0)
    assert middle[1] == pytest.approx(3.5)
    assert 0.5 < low[1] < 3.5 < high[1] < 6.5
