from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from sb3_options.density.regions import Region
from sb3_options.embedding.encoders import ObservationForm
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.experience.observations import FloatArray, flatten
from sb3_options.options import option
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import CACHE_BATCH, KnownFeatures, KnownResults, SubgoalOption
from sb3_options.options.policies import TabularPolicy


class Squares:
    """A function of a batch of numbers that notes for which it was computed."""

    def __init__(self) -> None:
        self.asked: list[float] = []

    def __call__(self, observations: Any) -> FloatArray:
        numbers = observations["x"] if isinstance(observations, dict) else observations
        self.asked += numbers.ravel().tolist()
        return np.asarray(numbers, dtype=np.float64).reshape(len(numbers)) ** 2


def batch(numbers: Sequence[int], *, as_dict: bool) -> Any:
    array = np.array(numbers, dtype=np.float64)[:, None]
    return {"x": array} if as_dict else array


@pytest.mark.parametrize("as_dict", [False, True])
def test_only_new_observations_are_computed(as_dict: bool) -> None:
    known, squares = KnownResults[np.float64](), Squares()
    for numbers, new in [([3], [3]), ([1, 3, 2], [1, 2]), ([2], []), ([3, 1], []), ([4, 4], [4, 4]), ([4], [])]:
        before = len(squares.asked)
        results = known(squares, batch(numbers, as_dict=as_dict))
        assert results.tolist() == [number**2 for number in numbers]
        assert squares.asked[before:] == new


@pytest.mark.parametrize("n", [0, CACHE_BATCH + 1])
def test_an_empty_or_large_batch_is_computed(n: int) -> None:
    known, squares = KnownResults[np.float64](), Squares()
    for _ in range(2):
        assert known(squares, batch(range(n), as_dict=False)).tolist() == [number**2 for number in range(n)]
    assert len(squares.asked) == 2 * n


@pytest.mark.parametrize(("repeats", "computed_again"), [(1, True), (3, False)])
def test_observations_that_seldom_repeat_are_cached_no_longer(
    monkeypatch: pytest.MonkeyPatch, repeats: int, computed_again: bool
) -> None:
    monkeypatch.setattr(option, "CACHE_BYTES", 100_000)
    known, squares = KnownResults[np.float64](), Squares()
    for number in range(1_000):
        for _ in range(repeats):
            assert known(squares, batch([number], as_dict=False)).tolist() == [number**2]
    before = len(squares.asked)
    known(squares, batch([999], as_dict=False))
    assert (len(squares.asked) > before) == computed_again


@pytest.mark.parametrize("n", [1, 2])
def test_features_are_refused_unless_each_observation_has_a_row(n: int) -> None:
    known = KnownFeatures(lambda observations: flatten(observations)[:1, :, None])
    with pytest.raises(ValueError, match=rf"feature_map must return a row .* shape \({n}, d\)"):
        known(np.zeros((n, 1)))


def test_memory_includes_room_for_later_results(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(option, "CACHE_BYTES", 1_000_000)
    known = KnownResults[np.float64]()
    for number in range(2_000):
        results = known(lambda seen: np.repeat(np.asarray(seen), 100, axis=1), np.array([[float(number)]]))
        assert (results == number).all()
        assert known._results.nbytes <= 1_300_000


@pytest.mark.parametrize("n", [1, 2])
def test_features_stay_when_an_environment_writes_into_its_last_observation(n: int) -> None:
    known = KnownFeatures(flatten)  # a view of numbers of 64 bits
    first = np.arange(n, dtype=np.float64)[:, None]
    buffer = first.copy()
    known(buffer)
    buffer += 7.0
    assert known(first).tolist() == first.tolist()


def reaching(goal: FloatArray, initiation: FloatArray, scale: float = 1.0) -> SubgoalOption:
    scales = np.full(goal.shape[1], scale)
    policy = TabularPolicy(np.zeros((1, 1)), np.zeros((1, 2)))
    return SubgoalOption(Region(goal, scales, 0.5), Region(initiation, scales, 0.5), policy)


def test_a_map_that_is_learned_anew_leaves_nothing_known() -> None:
    places = np.array([[3.0], [4.0], [9.0]])
    learned, other = (LearnedMap(ObservationForm("vector", (1,)), seed) for seed in (0, 5))
    bank = OptionBank(2, 1, feature_map=learned)
    bank.add(reaching(learned(places[2:]), learned(places[:2]), scale=1e6))
    here: Any = bank[0]
    assert bank.may_start(0, places[0])
    assert all(here.initiation(places[:n]).all() for n in (1, 2))
    learned.load(other.arrays())
    assert not bank.may_start(0, places[0])
    assert not bank.membership(0, places[0])[0]
    assert not bank.available_slots(places[:1]).any()
    assert not any(here.initiation(places[:n]).any() for n in (1, 2))


def test_options_are_asked_with_the_feature_map_that_each_is_bound_to() -> None:
    places = np.array([[3.0], [4.0]])
    bank = OptionBank(2, 2, feature_map=flatten)
    bank.add(reaching(np.array([[9.0]]), places))
    bank.feature_map = lambda observations: flatten(observations) + 100.0
    bank.add(reaching(np.array([[109.0]]), places + 100.0))
    assert bank.available_slots(places).all()
