"""Settings that check themselves, and checks of single values.

A field's type states its range, as in ``capacity: Annotated[int, Field(ge=1)] = 100``. `settings` makes a frozen
dataclass that refuses any other value and names the field. pydantic does the checking, here and when a file is loaded
into the same class.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, TypeVar, dataclass_transform

from pydantic import ConfigDict, ValidationError
from pydantic import Field as Field
from pydantic.dataclasses import dataclass

from sb3_options.state import storable

T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(cls: type[T]) -> type[T]:
    """Make a frozen dataclass whose constructor refuses values outside its fields' types and ranges.

    The constructor raises `TypeError` for an unknown name, and `ValueError` for a value of another type or outside its
    range. Conditions on several fields stand in the class's ``__post_init__``.
    """
    made = dataclass(frozen=True, config=ConfigDict(extra="forbid"))(cls)
    check: Callable[..., None] = made.__init__
    names = tuple(made.__dataclass_fields__)

    @functools.wraps(check)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807  # it replaces the generated one
        try:
            check(self, *args, **kwargs)
        except ValidationError as error:
            unknown = any(e["type"].startswith("unexpected_") for e in error.errors())  # by keyword or position
            raise (TypeError if unknown else ValueError)(f"{cls.__name__}: {readable(error, names)}") from None

    made.__init__ = __init__  # type: ignore[method-assign]  # it takes the same arguments as the generated one
    return storable(made)  # type: ignore[arg-type]  # pydantic types it as a class of its own, and it is ``cls`` itself


def is_number(value: object) -> bool:
    """Return whether a value is one real number that can be compared with others; NaN is one, a truth value is not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def whole(value: object, least: int) -> bool:
    """Return whether a value is a whole number of at least ``least``."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


def given_as(cls: type[T], given: T | Mapping[str, Any]) -> T:
    """Return settings as given, or make them from a mapping of fields."""
    return given if isinstance(given, cls) else cls(**given)  # type: ignore[arg-type]  # a mapping, or Python refuses it


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their full names, with dots."""
    values: dict[str, Any] = {}
    for name, value in settings.items():
        values |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return values


def readable(error: ValidationError, names: Sequence[str] = ()) -> str:
    """Return one line with the name, expected and given value of every wrong field."""
    return "; ".join(_readable(e, names) for e in error.errors(include_url=False))


def _readable(error: Any, names: Sequence[str]) -> str:
    first, *rest = error["loc"] or ("",)
    first = names[first] if isinstance(first, int) and first < len(names) else first
    name = ".".join(map(str, [first, *rest]))
    message = str(error["msg"])
    if error["type"] == "missing":
        return f"{name} is missing"
    if error["type"] == "unexpected_keyword_argument":
        return f"there is no setting {name!r}"
    if error["type"] == "value_error":  # from a __post_init__, which words its own message
        return str(error["ctx"]["error"])
    return f"{name} {message.removeprefix('Input ')}, got {error['input']!r}"
