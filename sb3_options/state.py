"""A class's fields are its checkpoint: one walk reads the state of an object, and one restores it in place.

::

    @dataclass(eq=False)
    class Tracker:
        settings: Settings
        success: SuccessRule = field(metadata=TRANSIENT)  # code: the training that resumes passes it again
        random: np.random.Generator
        counts: Counter[bytes] = field(default_factory=Counter)

    state = state_of(tracker)
    restore(tracker, state)

Mutable parts are restored in place: dataclasses, random generators, torch modules and optimizers, and objects with
their own ``get_state`` and ``set_state``. So are lists, dictionaries, sets and deques. A class that is not a dataclass
names its attributes in ``STATE``. Elements of a container that do not exist before `restore` must be plain values,
arrays, or objects of a class decorated with `storable`.
"""

import dataclasses
import functools
import sys
from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

T = TypeVar("T")

TRANSIENT: Final = {"transient": True}  # marks a dataclass field that is no state: code, settings passed anew, caches
VALUES: dict[str, type[Any]] = {}  # classes whose objects a checkpoint may contain, by name; `storable` adds to them
FOREIGN: dict[type[Any], tuple[str, ...]] = {}  # attributes that are the state of another library's class (`declare`)
PLAIN = (type(None), bool, int, float, str, bytes, np.ndarray, np.generic)


def storable(cls: type[T]) -> type[T]:
    """Class decorator: a checkpoint stores objects of this class whole, and recreates them from their fields.

    The class is a dataclass whose constructor takes all fields, a named tuple, or names the arguments of its
    constructor in ``STATE``.
    """
    other = VALUES.setdefault(cls.__name__, cls)
    if (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
        raise ValueError(f"There are two storable classes of the name {cls.__name__}: {other} and {cls}.")
    VALUES[cls.__name__] = cls
    return cls


def declare(cls: type[Any], *names: str) -> None:
    """Declare the attributes that are the state of a class of another library."""
    FOREIGN[cls] = names


@storable
class Part(NamedTuple):
    """The state of a mutable object inside another one."""

    of: str  # name of its class
    state: Any  # from ``get_state``; None if the same object has occurred before


def names_of(cls: type[Any]) -> tuple[str, ...]:
    """Return the names of the attributes that are the state of a class."""
    declared = [vars(base)["STATE"] for base in reversed(cls.__mro__) if "STATE" in vars(base)]
    if not declared and "__dataclass_fields__" in vars(cls):
        return tuple(each.name for each in dataclasses.fields(cls) if not each.metadata.get("transient"))
    if not declared:
        declared = [FOREIGN[base] for base in cls.__mro__ if base in FOREIGN][:1]
    if not declared and issubclass(cls, tuple) and hasattr(cls, "_fields"):
        declared = [cls._fields]
    if not declared:
        raise TypeError(
            f"a {cls.__name__} cannot be stored: make it a dataclass, or give it get_state() and set_state(state)"
        )
    return tuple(name for names in declared for name in names)


def made(name: str, fields: Mapping[str, Any]) -> Any:
    """Make an object of a class decorated with `storable`."""
    if name not in VALUES:
        raise ValueError(f"it holds a {name!r}, which is not known")
    return VALUES[name](**fields)


def state_of(owner: object) -> dict[str, Any]:
    """Return the state of an object, by the names of its attributes.

    It refers to the object's arrays: store or copy it before the object changes. The object's own ``get_state`` is not
    called, so that method may return ``{**state_of(self), ...}``.
    """
    return _fields(owner, type(owner).__name__, {})


def restore(owner: Any, state: Mapping[str, Any]) -> None:
    """Write a state from `state_of` into an object that was made with the same arguments.

    The object's own ``set_state`` is not called. The object takes over the arrays.
    """
    for name in _names(owner):
        setattr(owner, name, _restored(getattr(owner, name, None), state[name], f"{type(owner).__name__}.{name}"))


def _names(owner: object) -> list[str]:
    """Return `names_of`, without those that an object of another library lacks."""
    foreign = isinstance(owner, tuple(FOREIGN))
    return [name for name in names_of(type(owner)) if not foreign or hasattr(owner, name)]


def _fields(owner: object, where: str, seen: dict[int, object]) -> dict[str, Any]:
    seen[id(owner)] = owner
    names = _names(owner)
    if dataclasses.is_dataclass(owner) and not hasattr(owner, "STATE"):
        declared = {each.name for each in dataclasses.fields(owner)}
        for name in getattr(owner, "__dict__", ()):
            if name not in declared and not isinstance(getattr(type(owner), name, None), functools.cached_property):
                raise TypeError(f"{where}.{name} is no field of {type(owner).__name__}, and would be lost: declare it")
    return {name: _kept(getattr(owner, name), f"{where}.{name}", seen, direct=True) for name in names}


def _kept(item: Any, where: str, seen: dict[int, object], *, direct: bool = False) -> Any:
    kind = type(item)
    if isinstance(item, PLAIN) or kind.__name__ in VALUES or _is_tensor(item):
        return item
    if isinstance(item, dict) and (direct or kind in (dict, OrderedDict, Counter)):
        pairs = {key: _kept(each, f"{where}[{key!r}]", seen) for key, each in item.items()}
        return kind(pairs) if kind in (OrderedDict, Counter) else pairs
    if kind in (set, frozenset):
        return item.copy()
    if kind in (list, tuple, deque):
        items = (_kept(each, f"{where}[{i}]", seen) for i, each in enumerate(item))
        return deque(items, item.maxlen) if isinstance(item, deque) else kind(items)
    if id(item) in seen:
        return Part(kind.__name__, None)
    seen[id(item)] = item
    return Part(kind.__name__, own_state(item, where, seen))


def own_state(item: Any, where: str = "", seen: dict[int, object] | None = None) -> Any:
    """Return the state of a mutable object by its own ``get_state``, or else by its fields."""
    if isinstance(item, np.random.Generator):
        return item.bit_generator.state
    if hasattr(item, "get_state"):  # torch's generators have it
        return item.get_state()
    if hasattr(item, "state_dict"):
        return dict(item.state_dict())
    try:
        return _fields(item, where or type(item).__name__, {} if seen is None else seen)
    except TypeError as error:
        raise error if where and where in str(error) else TypeError(f"{error}, at {where}") from None


def _restored(present: Any, item: Any, where: str) -> Any:
    """Return the item, or the present object with the item's state."""
    if isinstance(item, Part):
        if type(present).__name__ != item.of:
            raise ValueError(f"{where} is a {type(present).__name__}, and was a {item.of}")
        if item.state is not None:
            set_own_state(present, item.state)
        return present
    if type(item).__name__ in VALUES:
        return item
    if isinstance(item, dict):
        pairs = {key: _restored(_at(present, key), each, f"{where}[{key!r}]") for key, each in item.items()}
        if not isinstance(present, dict):
            return type(item)(pairs)
        present.clear()
        present.update(pairs)
        return present
    if isinstance(item, list | tuple | deque):
        items = [_restored(_at(present, i), each, f"{where}[{i}]") for i, each in enumerate(item)]
        if not isinstance(present, list | deque):
            return deque(items, item.maxlen) if isinstance(item, deque) else type(item)(items)
        present.clear()
        present.extend(items)
        return present
    if isinstance(item, set) and isinstance(present, set):
        present.clear()
        present.update(item)
        return present
    return item.to(present.device) if _is_tensor(item) and _is_tensor(present) else item


def set_own_state(present: Any, state: Any) -> None:
    """Write a state from `own_state` into an object."""
    if isinstance(present, np.random.Generator):
        present.bit_generator.state = state
    elif hasattr(present, "set_state"):
        present.set_state(state)
    elif hasattr(present, "load_state_dict"):
        present.load_state_dict(state)
    else:
        restore(present, state)


def _at(container: Any, key: Any) -> Any:
    if isinstance(container, dict):
        return container.get(key)
    indexed = isinstance(container, list | tuple | deque) and isinstance(key, int)
    return container[key] if indexed and key < len(container) else None


def _is_tensor(item: object) -> bool:
    torch = sys.modules.get("torch")  # if there is a tensor, torch is imported
    return torch is not None and isinstance(item, torch.Tensor)
