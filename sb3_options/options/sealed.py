"""Files of JSON and arrays under one digest, in safetensors: options files and checkpoints. Nothing in them can run."""

import hashlib
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load as from_safetensors
from safetensors.numpy import save as to_safetensors

from sb3_options.checked import readable

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]

DAMAGE = (
    SafetensorError, zipfile.BadZipFile, zlib.error, EOFError, OSError, MemoryError, RuntimeError,
    ValueError, TypeError, LookupError, AttributeError, OverflowError,
)  # fmt: skip
"""Errors that readers raise for a damaged file, or for one that a stranger made up."""


@contextmanager
def errors_of(name: str, what: str) -> Iterator[None]:
    """Turn `DAMAGE` into a `ValueError` that names the file and says ``what`` is wrong with it."""
    try:
        yield
    except DAMAGE as error:
        why = readable(error) if isinstance(error, ValidationError) else str(error)
        why = repr(error) if isinstance(error, LookupError) else why.rstrip(".")
        raise ValueError(f"{name} {what}: {why}.") from error


def sealed(file_format: str, parts: Mapping[str, Any], arrays: Arrays) -> bytes:
    """Return the content of a file with JSON values and arrays; equal values give equal bytes."""
    texts = {name: json.dumps(part) for name, part in parts.items()}
    content = to_safetensors(arrays, metadata={"format": file_format, **texts, "digest": digest(texts, arrays)})
    header, start = _header(content)
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))  # safetensors' order is random
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[start:]


def unsealed(content: bytes, file_format: str) -> tuple[dict[str, Any], Arrays]:
    """Return what `sealed` sealed, or raise `DAMAGE`."""
    arrays = {name: np.array(array) for name, array in from_safetensors(content).items()}
    texts = _header(content)[0].get("__metadata__", {})
    found = texts.pop("format", None)
    if found != file_format:
        raise ValueError(f"its format is {found!r}, expected {file_format!r}")
    if texts.pop("digest") != digest(texts, arrays):
        raise ValueError("its contents are not what was written to it")
    return {name: json.loads(text) for name, text in texts.items()}, arrays


def digest(texts: Mapping[str, str], arrays: Arrays) -> str:
    """Return the SHA-256 of all texts and arrays of a file."""
    sha256 = hashlib.sha256("".join(texts[name] for name in sorted(texts)).encode())
    for name in sorted(arrays):
        sha256.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        sha256.update(arrays[name].tobytes())
    return sha256.hexdigest()


def _header(content: bytes) -> tuple[dict[str, Any], int]:
    """Return the header of a safetensors file, and the offset of its arrays."""
    start = 8 + int.from_bytes(content[:8], "little")
    return json.loads(content[8:start]), start
