"""Blocks of arrays that are written row by row: which of them need not be read again for a checkpoint."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_options.learning.replay_buffer import Growing


class _Written(NamedTuple):
    array: weakref.ref[npt.NDArray[Any]]
    growth: tuple[int, int, int]
    per_block: int
    names: list[str]


class KnownBlocks:
    """The names of the blocks that the last checkpoint was written with, for arrays that tell how they grow."""

    def __init__(self, growing: Sequence[Growing] = (), before: KnownBlocks | None = None) -> None:
        self._growing = {_address(each.array): each for each in growing}
        self._before = {} if before is None else before._written
        self._written: dict[int, _Written] = {}

    def unchanged(self, rows: npt.NDArray[Any], per_block: int) -> dict[int, str]:
        """Names of the blocks whose rows have not changed, by their first row."""
        now, then = self._growing.get(_address(rows)), self._before.get(_address(rows))
        if now is None or then is None or then.array() is not now.array or then.per_block != per_block:
            return {}
        written, at, changes = then.growth
        new = now.written - written
        if now.changes != changes or new < 0 or new >= len(now.array):
            return {}
        end = at + new  # beyond the last row it goes on with the first one
        over = end - len(now.array)
        starts = (number * per_block for number in range(len(then.names)))
        return {
            start: name
            for start, name in zip(starts, then.names, strict=True)
            if (start + per_block <= at or start >= end) and start >= over
        }

    def keep(self, rows: npt.NDArray[Any], per_block: int, names: list[str]) -> None:
        """Remember the blocks of an array, if it tells how it grows."""
        now = self._growing.get(_address(rows))
        if now is not None:
            growth = now.written, now.at, now.changes
            self._written[_address(rows)] = _Written(weakref.ref(now.array), growth, per_block, names)


def _address(array: npt.NDArray[Any]) -> int:
    return int(np.asarray(array).__array_interface__["data"][0])
