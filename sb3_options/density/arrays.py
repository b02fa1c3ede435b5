"""Array types, and keys of rows."""

from hashlib import blake2b
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]

LONGEST_KEY = 64  # bytes; a longer one is replaced by a digest


def row_keys(rows: NDArray[Any]) -> list[bytes]:
    """Return the bytes of each row (n, d), d ≥ 1. Equal rows share a key: adding 0 turns -0 into 0."""
    rows = np.ascontiguousarray(rows + 0.0 if rows.dtype.kind == "f" else rows)
    return rows.view(f"V{rows.itemsize * rows.shape[1]}").ravel().tolist()


def distinct_rows(rows: NDArray[Any]) -> NDArray[Any]:
    """Return the sorted distinct rows of rows (n, d), sooner than ``numpy.unique`` where most repeat; -0 equals 0."""
    last = {key: i for i, key in enumerate(row_keys(rows))}
    return np.unique(rows[list(last.values())], axis=0)


def short_key(key: bytes) -> bytes:
    """Return the key, or if it is longer than ``LONGEST_KEY``, a digest to save memory."""
    return key if len(key) <= LONGEST_KEY else blake2b(key, digest_size=16).digest()
