"""Damaged files: is each refused, or is one of them read as something else?"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sb3_options.options.file import opened
from sb3_options.options.sealed import digest

Read = Callable[[Path], bytes]
"""Reads a file, and says what was in it as bytes, equal for equal contents."""

MAX_BLOCK = 4096
"""Bytes of the largest block that is overwritten or exchanged."""


def damaged(content: bytes, random: np.random.Generator) -> tuple[str, bytes]:
    """The content with one random damage, and what that is; never equal to ``content``."""
    while True:
        kind = str(random.choice(["flipped", "cut", "exchanged", "zeros", "noise", "longer"]))
        new = _with(kind, content, random)
        if new != content:
            return kind, new


def _with(kind: str, content: bytes, random: np.random.Generator) -> bytes:
    data = bytearray(content)
    size = int(random.integers(1, min(MAX_BLOCK, len(data) // 2)))
    at, other = (int(start) for start in random.integers(0, len(data) - size, size=2))
    if kind == "flipped":
        for place in random.integers(len(data), size=int(random.integers(1, 9))):
            data[place] ^= 1 << int(random.integers(8))
    elif kind == "cut":
        del data[int(random.integers(len(data))) :]
    elif kind == "exchanged":
        first, second = data[at : at + size], data[other : other + size]
        data[at : at + size] = second
        data[other : other + size] = first
    elif kind == "longer":
        data += random.bytes(size)
    else:
        data[at : at + size] = bytes(size) if kind == "zeros" else random.bytes(size)
    return bytes(data)


def options_in(path: Path) -> bytes:
    """What the options of an options file or a ``model.zip`` are; a `Read`."""
    file = opened(path)
    return digest({"about": repr(file[1:6])}, file.tensors).encode()


def check(path: Path, read: Read, n: int, random: np.random.Generator) -> dict[str, dict[str, int]]:
    """Damage a file ``n`` times, and read it.

    Returns:
        How often by kind of damage: ``refused``, a ``ValueError`` that names the file; ``unharmed``, the whole content
        was read all the same (the damage lies in another part of a zip); ``wrong``, something else was read;
        ``error``, any other exception.
    """
    whole = read(path)
    counts: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(n):
            kind, content = damaged(path.read_bytes(), random)
            copy = Path(folder) / path.name
            copy.write_bytes(content)
            counts.setdefault(kind, Counter())[_outcome(copy, read, whole)] += 1
    return {kind: dict(counts[kind]) for kind in sorted(counts)}


def _outcome(path: Path, read: Read, whole: bytes) -> str:
    try:
        found = read(path)
    except ValueError as error:
        return "refused" if str(path) in str(error) else "error"
    except Exception:
        return "error"
    return "unharmed" if found == whole else "wrong"
