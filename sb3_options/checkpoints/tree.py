"""States as JSON and arrays: `encode` takes them apart, `decode` puts them together.

A state is made of None, truth values, numbers, text, bytes, arrays, tensors, lists, tuples, dictionaries and the
records of `sb3_options.checkpoints.records`. Nothing else can be in it, so that reading one runs nothing. What is one
object in two places is one object again: incremental search knows a bag by being the same array.
"""

from __future__ import annotations

import dataclasses
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

State: TypeAlias = dict[str, Any]
"""What ``get_state`` gives and ``set_state`` takes."""

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]

MARK = "$"
"""Key of a JSON object that stands for something else than a dictionary."""

PLAIN = (bool, int, str, float, type(None))
KINDS = "biuf"
"""Kinds of arrays that safetensors holds: truth values, whole numbers and floats."""


class Record(NamedTuple):
    """How objects of one class are taken apart and made.

    Attributes:
        cls: The class.
        make: From the fields, by name.
        fields: Of an object, by name.
    """

    cls: type[Any]
    make: Callable[..., Any]
    fields: Callable[[Any], State]


def record(cls: type[Any]) -> Record:
    """Of a dataclass or named tuple, whose constructor takes all of its fields."""
    names = [f.name for f in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else list(cls._fields)
    return Record(cls, cls, lambda each: {name: getattr(each, name) for name in names})


def encode(state: Any, records: Mapping[str, Record]) -> tuple[Any, Arrays]:
    """A state as JSON and arrays by number.

    Args:
        state: The whole one: what is the same object in two places is stored once.
        records: By name.

    Raises:
        TypeError: There is something in it that cannot be stored; the text says where.
    """
    encoder = _Encoder(records)
    return encoder.encoded(state, ""), encoder.arrays


def decode(content: Any, arrays: Arrays, records: Mapping[str, Record]) -> Any:
    """The inverse of `encode`; arrays are taken over, not copied.

    Raises:
        ValueError: The content was not made by `encode`, or arrays are missing.
    """
    try:
        return _Decoder(arrays, records).decoded(content)
    except (KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise ValueError(f"it is damaged: {error!r}") from error


class _Encoder:
    def __init__(self, records: Mapping[str, Record]) -> None:
        self._by_class = {each.cls: (name, each) for name, each in records.items()}
        self.arrays: Arrays = {}
        self._numbers: dict[int, str] = {}
        self._records: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no other object takes an id

    def encoded(self, value: Any, where: str) -> Any:
        kind = type(value)
        if kind in PLAIN:
            return value if kind is not float or math.isfinite(value) else {MARK: "float", "value": repr(value)}
        if kind in (dict, OrderedDict):  # vectorised environments give the latter
            return self._dictionary(value, where)
        if kind is list:
            return [self.encoded(each, f"{where}[{i}]") for i, each in enumerate(value)]
        if kind in self._by_class:
            return self._record(value, where)
        if kind is tuple:
            return {MARK: "tuple", "items": [self.encoded(each, f"{where}[{i}]") for i, each in enumerate(value)]}
        if isinstance(value, torch.Tensor):
            return {MARK: "tensor", **self._array(value, value.detach().cpu().numpy(), where)}
        if kind is np.ndarray:
            return {MARK: "array", **self._array(value, value, where)}
        if isinstance(value, np.generic):
            return {MARK: "scalar", **self._array(value, np.asarray(value), where)}
        if kind is bytes:
            return {MARK: "bytes", **self._array(value, np.frombuffer(value, dtype=np.uint8), where)}
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
        # Products with an array that is laid out the other way round differ in the last bit.
        transposed = array.flags.f_contiguous and not array.flags.c_contiguous
        if number is None:
            number = self._numbers[id(value)] = str(len(self.arrays))
            self._kept.append(value)
            self.arrays[number] = np.ascontiguousarray(array.T if transposed else array).reshape(
                array.shape[::-1] if transposed else array.shape
            )
        return {"array": number, "transposed": True} if transposed else {"array": number}

    def _record(self, value: Any, where: str) -> State:
        if id(value) in self._records:
            return {MARK: "same", "record": self._records[id(value)]}
        name, how = self._by_class[type(value)]
        fields = self.encoded(how.fields(value), f"{where}<{name}>")
        self._records[id(value)] = len(self._records)  # after those inside it, as they are made
        self._kept.append(value)
        return {MARK: name, "fields": fields}


class _Decoder:
    def __init__(self, arrays: Arrays, records: Mapping[str, Record]) -> None:
        self._arrays, self._how = arrays, records
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
            return self._made[content["record"]]
        if mark == "float":
            return float(content["value"])
        if mark == "tuple":
            return tuple(self.decoded(each) for each in content["items"])
        if mark == "map":
            return {self.decoded(key): self.decoded(each) for key, each in content["items"]}
        if mark in ("array", "tensor", "scalar", "bytes"):
            return self._array(content, mark)
        if mark not in self._how:
            raise ValueError(f"it holds a {mark!r}, which is not known")
        fields = self.decoded(content["fields"])
        made = self._how[mark].make(**fields)
        self._made.append(made)
        return made

    def _array(self, content: State, mark: str) -> Any:
        number = content["array"]
        array = self._arrays[number]
        if content.get("transposed"):
            array = self._views.setdefault(number, array.T)
        if mark == "scalar":
            return array[()]
        if mark == "bytes":
            return array.tobytes()
        return self._tensors.setdefault(number, torch.from_numpy(array)) if mark == "tensor" else array
