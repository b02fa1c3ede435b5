"""Whether two states are equal, byte for byte, but for what the clock says."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sb3_options.checkpoints.tree import State, encode
from sb3_options.options.sealed import Arrays
from sb3_options.state import Part

OF_THE_CLOCK = frozenset(
    (
        "seconds",
        "elapsed",
        "t",
        "episode_times",
        "time/fps",
        "time/time_elapsed",
        "search/seconds",
        "event_files",
        "bytes",
    )
)
"""Entries that say how long something took; no two runs agree about them."""


def differing(one: State, other: State) -> list[str]:
    """Where two states of trainings differ; empty if they do not.

    Args:
        one: As a checkpoint holds it.
        other: Likewise.
    """
    first, second = (encode(_without_clock(state)) for state in (one, other))
    return list(_differences(first[0], second[0], first[1], second[1], ""))


def _without_clock(value: Any) -> Any:
    if type(value) is dict:
        return {key: _without_clock(each) for key, each in value.items() if key not in OF_THE_CLOCK}
    if isinstance(value, Part):
        return Part(value.of, _without_clock(value.state))
    return [_without_clock(each) for each in value] if type(value) is list else value


def _differences(one: Any, other: Any, arrays: Arrays, others: Arrays, where: str) -> Iterator[str]:
    if type(one) is not type(other):
        yield f"{where}: {one!r} and {other!r}"
    elif isinstance(one, dict):
        for key in [*one, *(key for key in other if key not in one)]:
            if key in OF_THE_CLOCK:
                continue
            if key not in one or key not in other:
                yield f"{where}.{key}: only in one"
            elif key == "array":
                a, b = arrays[one[key]], others[other[key]]
                if (a.shape, a.dtype) != (b.shape, b.dtype) or a.tobytes() != b.tobytes():
                    yield f"{where}: other arrays, {a.shape} and {b.shape}"
            else:
                yield from _differences(one[key], other[key], arrays, others, f"{where}.{key}")
    elif isinstance(one, list):
        if len(one) != len(other):
            yield f"{where}: {len(one)} and {len(other)} entries"
        for i, (a, b) in enumerate(zip(one, other, strict=False)):
            yield from _differences(a, b, arrays, others, f"{where}[{i}]")
    elif one != other:
        yield f"{where}: {one!r} and {other!r}"
