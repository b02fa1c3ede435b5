from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from sb3_options.options import option
from sb3_options.options.option import CACHE_BATCH, KnownResults


class Squares:
    """A function of a batch of numbers that notes for which it was computed."""

    def __init__(self) -> None:
        self.asked: list[float] = []

    def __call__(self, observations: Any) -> npt.NDArray[np.float64]:
        numbers = observations["x"] if isinstance(observations, dict) else observations
        self.asked += numbers.ravel().tolist()
        return np.asarray(numbers, dtype=np.float64).reshape(len(numbers)) ** 2


def batch(numbers: Sequence[int], *, as_dict: bool) -> Any:
    array = np.array(numbers, dtype=np.float64)[:, None]
    return {"x": array} if as_dict else array


@pytest.mark.parametrize("as_dict", [False, True])
def test_only_new_observations_are_computed(as_dict: bool) -> None:
    known: KnownResults[np.float64] = KnownResults()
    squares = Squares()
    for numbers, new in [([3], [3]), ([1, 3, 2], [1, 2]), ([2], []), ([3, 1], []), ([4, 4], [4, 4]), ([4], [])]:
        before = len(squares.asked)
        results = known(squares, batch(numbers, as_dict=as_dict))
        assert results.tolist() == [number**2 for number in numbers]
        assert squares.asked[before:] == new


@pytest.mark.parametrize("n", [0, CACHE_BATCH + 1])
def test_an_empty_or_large_batch_is_computed(n: int) -> None:
    known: KnownResults[np.float64] = KnownResults()
    squares = Squares()
    for _ in range(2):
        assert known(squares, batch(range(n), as_dict=False)).tolist() == [number**2 for number in range(n)]
    assert len(squares.asked) == 2 * n


@pytest.mark.parametrize(("repeats", "computed_again"), [(1, True), (3, False)])
def test_observations_that_seldom_repeat_are_cached_no_longer(
    monkeypatch: pytest.MonkeyPatch, repeats: int, computed_again: bool
) -> None:
    monkeypatch.setattr(option, "CACHE_BYTES", 100_000)
    known: KnownResults[np.float64] = KnownResults()
    squares = Squares()
    for number in range(1_000):
        for _ in range(repeats):
            assert known(squares, batch([number], as_dict=False)).tolist() == [number**2]
    before = len(squares.asked)
    known(squares, batch([999], as_dict=False))
    assert (len(squares.asked) > before) == computed_again
