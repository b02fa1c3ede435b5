from collections import OrderedDict
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from sb3_options.experience import observations as obs
from sb3_options.experience.observations import Observations, key_of, stack, take

ARRAYS = [np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]]), np.array([[5.0, 6.0]])]
DICTS = [{"b": np.array([i, i + 1]), "a": np.array(10 * i)} for i in range(3)]


def same(left: Observations, right: Observations) -> bool:
    if isinstance(left, np.ndarray):
        return isinstance(right, np.ndarray) and np.array_equal(left, right) and left.dtype == right.dtype
    assert not isinstance(right, np.ndarray)
    return left.keys() == right.keys() and all(same(left[k], right[k]) for k in left)


@pytest.mark.parametrize("observations", [[0, 1, 2], ARRAYS, DICTS])
def test_stack_take_concatenate_and_batch_of_one_agree(observations: list[Any]) -> None:
    batch = stack(observations)
    assert obs.batch_size(batch) == 3
    assert same(obs.concatenate([obs.batch_of_one(o) for o in observations]), batch)
    assert same(take(batch, np.array([2, 0])), stack([observations[2], observations[0]]))
    assert same(take(batch, slice(1, 2)), obs.batch_of_one(observations[1]))


@pytest.mark.parametrize(
    ("observations", "expected"),
    [
        (np.array([3, 4]), [[3.0], [4.0]]),
        (np.array([[[1, 2], [3, 4]]], dtype=np.uint8), [[1.0, 2.0, 3.0, 4.0]]),
        ({"b": np.array([[1, 2]]), "a": np.array([[[7], [8]]])}, [[7.0, 8.0, 1.0, 2.0]]),
        (np.zeros((0, 3)), np.zeros((0, 3))),
    ],
)
def test_flatten(observations: Observations, expected: list[list[float]]) -> None:
    flat = obs.flatten(observations)
    assert flat.dtype == np.float64
    np.testing.assert_array_equal(flat, expected)


def test_keys_are_equal_exactly_if_observations_are() -> None:
    assert len({key_of(o) for o in (0, 1, -1)}) == 3
    assert key_of(np.int64(3)) == key_of(3)
    assert key_of({"a": 1, "b": 2}) == key_of({"b": 2, "a": 1})
    assert key_of({"a": 1, "b": 2}) != key_of({"a": 2, "b": 1})
    assert key_of(np.array([0.1 + 0.2])) != key_of(np.array([0.3]))


@pytest.mark.parametrize(
    "observations", [[0, 1, 1], ARRAYS, DICTS, [np.zeros(0)] * 2, [np.asfortranarray(np.eye(2)), np.ones((2, 2))]]
)
def test_keys_of_a_batch_are_those_of_each(observations: list[Any]) -> None:
    assert obs.keys_of(stack(observations)) == [key_of(each) for each in observations]
    assert obs.keys_of(take(stack(observations), slice(0, 0))) == []


@pytest.mark.parametrize("observations", [[0, 1, 2], ARRAYS, DICTS])
def test_replaced_rows_leave_the_batch_as_it_was(observations: list[Any]) -> None:
    batch = stack(observations)
    changed = obs.replaced(batch, [0, 2], stack([observations[1], observations[0]]))
    assert same(changed, stack([observations[1], observations[1], observations[0]]))
    assert same(batch, stack(observations))


@pytest.mark.parametrize("kind", [dict, OrderedDict, MappingProxyType])
def test_a_copy_does_not_change_with_the_original(kind: Any) -> None:
    array = np.array([1.0, 2.0])
    copied, copied_dict = obs.copy_of(array), obs.copy_of(kind({"a": array}))
    array[:] = 0.0
    assert copied.tolist() == copied_dict["a"].tolist() == [1.0, 2.0]
