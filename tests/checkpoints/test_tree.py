import json
import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from sb3_options.checkpoints.tree import decode, encode
from sb3_options.density.regions import Region
from sb3_options.options.sealed import DAMAGE
from sb3_options.state import storable


@storable
class Number(NamedTuple):
    n: int
    x: float
    done: bool


def there_and_back(state: object) -> Any:
    content, arrays = encode(state)
    return decode(json.loads(json.dumps(content)), arrays)


VALUES: list[object] = [
    *(None, True, 3, 1 << 100, 0.1, -math.inf, "text", b"\0\xff", (1, (2, "x")), [], {}, {"$": 1}, {1: {"a": ()}}),
    *({3, 1}, deque([1, (2,)], 5), {b"a": 1, b"": 2, b"abc": -3}, [Number(i, i / 3, done=i > 5) for i in range(20)]),
]


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_values_come_back_as_they_were(value: object) -> None:
    back = there_and_back({"value": value})
    assert back == {"value": value}
    assert repr(back) == repr({"value": value})


@pytest.mark.parametrize("dtype", ["bool", "uint8", "int64", "float32", "float64"])
@pytest.mark.parametrize("shape", [(), (0, 3), (4,), (2, 3)])
def test_arrays_come_back_byte_for_byte(dtype: str, shape: tuple[int, ...]) -> None:
    array = np.arange(math.prod(shape)).reshape(shape).astype(dtype)
    back = there_and_back([array])[0]
    assert (back.dtype, back.shape, back.tobytes()) == (array.dtype, shape, array.tobytes())


def test_an_array_lies_in_memory_as_it_did() -> None:
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    back = there_and_back({"a": array})["a"]
    assert back.flags.f_contiguous
    assert not back.flags.c_contiguous
    np.testing.assert_array_equal(back, array)


def test_scalars_and_tensors_keep_their_types() -> None:
    back = there_and_back({"scalar": np.float32(1.5), "tensor": torch.arange(3)})
    assert isinstance(back["scalar"], np.float32)
    assert torch.equal(back["tensor"], torch.arange(3))


def test_one_object_in_two_places_is_one_object_again() -> None:
    points = np.zeros((1, 2))
    region = Region(points, np.ones(2), 1.0)
    back = there_and_back({"regions": [region, region], "points": points})
    first, second = back["regions"]
    assert first is second
    assert first.points is back["points"]


@pytest.mark.parametrize(
    ("value", "what"),
    [(bytearray(), "a bytearray"), (np.array([None]), "an array of object"), (print, "a builtin"), (1j, "a comp")],
)
def test_says_what_cannot_be_stored_and_where(value: object, what: str) -> None:
    with pytest.raises(TypeError, match=rf"^{what}.* cannot be stored, at .a\[0\]$"):
        encode({"a": [value]})


@pytest.mark.parametrize(
    "content",
    [
        {"$": "os.system", "fields": {}},
        {"$": "Region", "fields": {"command": "ls"}},
        {"$": "Region", "fields": [1]},
        {"$": "array", "array": "9"},
        {"$": "same", "value": 5},
        {"$": "deque", "items": [], "maxlen": -1},
        {"$": "map", "items": [[{}, 1]]},
    ],
    ids=str,
)
def test_refuses_what_encode_does_not_make(content: object) -> None:
    with pytest.raises(DAMAGE):
        decode(content, {})
