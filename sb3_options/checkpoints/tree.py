"""States as JSON and arrays: `encode` takes them apart, `decode` puts them together.

A state consists of None, Booleans, numbers, text, bytes, arrays, tensors, lists, tuples, dictionaries, sets, deques and
classes decorated with `sb3_options.state.storable`, and of nothing else. So reading a state runs no code of the file.
An array or a value that occurs twice becomes one object again.
"""

import base64
import math
from collections import deque
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from sb3_options.options.sealed import Arrays
from sb3_options.state import VALUES, made, names_of

State: TypeAlias = dict[str, Any]  # result of ``get_state`` and argument of ``set_state``
MARK = "$"  # key of a JSON object that is not a dictionary

PLAIN = (bool, int, str, float, type(None))
KINDS = "biuf"  # kinds of arrays that safetensors holds: Booleans, integers and floats


def encode(state: Any) -> tuple[Any, Arrays]:
    """Turn a state into JSON and numbered arrays. An object that occurs twice is stored once."""
    encoder = _Encoder()
    return encoder.encoded(state, ""), encoder.arrays


def decode(content: Any, arrays: Arrays) -> Any:
    """Invert `encode`, raising `sealed.DAMAGE`. Arrays are used without a copy."""
    return _Decoder(arrays).decoded(content)


class _Encoder:
    def __init__(self) -> None:
        self.arrays: Arrays = {}
        self._numbers: dict[int, str] = {}
        self._values: dict[int, int] = {}
        self._kept: list[Any] = []  # keeps ids unique

    def encoded(self, value: Any, where: str) -> Any:
        kind = type(value)
        if kind in PLAIN:
            return value if kind is not float or math.isfinite(value) else {MARK: "float", "value": repr(value)}
        if isinstance(value, dict):
            return self._dictionary(value, where)
        if kind is list:
            return [self.encoded(each, f"{where}[{i}]") for i, each in enumerate(value)]
        if VALUES.get(kind.__name__) is kind:
            return self._value(value, where)
        if kind is tuple:
            return {MARK: "tuple", "items": [self.encoded(each, f"{where}[{i}]") for i, each in enumerate(value)]}
        if isinstance(value, torch.Tensor):
            return {MARK: "tensor", **self._array(value, value.detach().cpu().numpy(), where)}
        if kind is np.ndarray:
            return {MARK: "array", **self._array(value, value, where)}
        if isinstance(value, np.generic):
            return {MARK: "scalar", **self._array(value, np.asarray(value), where)}
        if kind is bytes:
            return {MARK: "bytes", "value": base64.b64encode(value).decode()}
        if kind is deque:
            items = [self.encoded(each, f"{where}[{i}]") for i, each in enumerate(value)]
            return {MARK: "deque", "items": items, "maxlen": value.maxlen}
        if kind is set:
            return {MARK: "set", "items": [self.encoded(each, where) for each in sorted(value)]}
        raise TypeError(f"a {kind.__name__} cannot be stored, at {where or 'the top'}")

    def _dictionary(self, value: dict[Any, Any], where: str) -> Any:
        if all(type(key) is str for key in value) and MARK not in value:
            return {key: self.encoded(each, f"{where}.{key}") for key, each in value.items()}
        items = [[self.encoded(k, where), self.encoded(each, f"{where}[{k!r}]")] for k, each in value.items()]
        return {MARK: "map", "items": items}

    def _array(self, value: Any, array: npt.NDArray[Any], where: str) -> State:
        if array.dtype.kind not in KINDS or not array.dtype.isnative:
            raise TypeError(f"an array of {array.dtype} cannot be stored, at {where}")
        number = self._numbers.get(id(value))
        # The memory layout changes the last bit of products, so it is kept.
        transposed = array.flags.f_contiguous and not array.flags.c_contiguous
        if number is None:
            number = self._numbers[id(value)] = str(len(self.arrays))
            self._kept.append(value)
            self.arrays[number] = np.ascontiguousarray(array.T if transposed else array).reshape(
                array.shape[::-1] if transposed else array.shape
            )
        return {"array": number, "transposed": True} if transposed else {"array": number}

    def _value(self, value: Any, where: str) -> State:
        if id(value) in self._values:
            return {MARK: "same", "value": self._values[id(value)]}
        name = type(value).__name__
        content = self.encoded({each: getattr(value, each) for each in names_of(type(value))}, f"{where}<{name}>")
        self._values[id(value)] = len(self._values)  # after the values inside it, in the order of decoding
        self._kept.append(value)
        return {MARK: name, "fields": content}


class _Decoder:
    def __init__(self, arrays: Arrays) -> None:
        self._arrays = arrays
        self._made: list[Any] = []
        self._tensors: dict[str, torch.Tensor] = {}
        self._views: dict[str, npt.NDArray[Any]] = {}

    def decoded(self, content: Any) -> Any:
        if isinstance(content, list):
            return [self.decoded(each) for each in content]
        if not isinstance(content, dict):
            return content
        mark = content.get(MARK)
        if mark is None:
            return {key: self.decoded(each) for key, each in content.items()}
        if mark == "same":
            return self._made[content["value"]]
        if mark == "float":
            return float(content["value"])
        if mark == "bytes":
            return base64.b64decode(content["value"])
        if mark in ("array", "tensor", "scalar"):
            return self._array(content, mark)
        if mark == "map":
            return {self.decoded(key): self.decoded(each) for key, each in content["items"]}
        if "items" in content:
            items = (self.decoded(each) for each in content["items"])
            return deque(items, content["maxlen"]) if mark == "deque" else {"tuple": tuple, "set": set}[mark](items)
        new = made(mark, self.decoded(content["fields"]))
        self._made.append(new)
        return new

    def _array(self, content: State, mark: str) -> Any:
        number = content["array"]
        array = self._arrays[number]
        if content.get("transposed"):
            array = self._views.setdefault(number, array.T)
        if mark == "scalar":
            return array[()]
        return self._tensors.setdefault(number, torch.from_numpy(array)) if mark == "tensor" else array
