"""Finds the content of an options file: in its own file, or in the ``model.zip`` of a model that uses it."""

import base64
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import TypeAlias

from sb3_options.options.sealed import errors_of

NAME = "options.safetensors"  # of the file in the folder of a run
CARRIED = "carried_options"  # attribute of a model, and entry of a ``model.zip``'s ``data``, with the content as text
MAX_BYTES = 1 << 30  # of content that is unpacked from a ``model.zip``: a small file must not fill the memory
NO_OPTIONS_FILE = "is no options file, or it is damaged"

Source: TypeAlias = str | os.PathLike[str] | bytes
"""Path of an options file or of a ``model.zip``, or the content of an options file."""


def content_in(source: Source) -> bytes:
    """Return the content of an options file from any source. It is not checked, and nothing is unpickled."""
    if isinstance(source, bytes):
        return source
    path = Path(source)
    with path.open("rb") as file:
        if file.read(4) != b"PK\3\4":
            file.seek(0)
            return file.read()
    with errors_of(str(path), NO_OPTIONS_FILE), zipfile.ZipFile(path) as archive:
        if "data" in archive.namelist():
            if archive.getinfo("data").file_size > MAX_BYTES:
                raise ValueError(f"data has more than {MAX_BYTES:,} bytes")
            data = json.loads(archive.read("data"))
            if CARRIED in data:
                return unpacked_text(data[CARRIED])
    raise ValueError(
        f"{path} holds no options: its model was saved without a callback of this library. If there is a file of its "
        "options, use that."
    )


def packed_text(content: bytes) -> str:
    """Return the content of an options file as text that fits into JSON."""
    return base64.b64encode(zlib.compress(content)).decode("ascii")


def unpacked_text(text: str) -> bytes:
    """Return the content that `packed_text` packed."""
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(base64.b64decode(text, validate=True), MAX_BYTES)
    if not unpacker.eof:
        raise ValueError(f"its options are cut off, or have more than {MAX_BYTES:,} bytes")
    return content
