"""Atomic writing of files."""

import os
import secrets
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = ".sb3-options-"  # of the names of temporary files
STALE = 3600.0  # seconds without a write after which a temporary file counts as left by a killed process


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, which it replaces once everything is on the disk.

    A full disk, an error or a killed process leaves an older file unchanged, with its rights. Remains of killed
    processes are removed (`remove_stale`). An `OSError` names ``path``.
    """
    final = Path(path)
    temporary: Path | None = None
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        remove_stale(final.parent)
        temporary = final.parent / f"{PREFIX}{secrets.token_hex(8)}{final.suffix}"
        temporary.touch(exist_ok=False)  # the system decides who may read it, as for any new file
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        if final.exists():
            temporary.chmod(stat.S_IMODE(final.stat().st_mode))
        temporary.replace(final)
    except OSError as error:
        # An open file notices a full disk, and its error names no file.
        if error.errno is not None and (error.filename is None or PREFIX in str(error.filename)):
            error.filename = str(final)
        raise
    finally:
        if temporary is not None:
            with suppress(OSError):  # a read-only file system raises even for a missing file
                temporary.unlink(missing_ok=True)


def remove_stale(folder: Path, pattern: str = "") -> None:
    """Remove the temporary files that killed processes left, `STALE` seconds after their last write."""
    for path in folder.glob(f"{pattern}{PREFIX}*"):
        with suppress(OSError):  # another process may remove it as well
            if time.time() - path.stat().st_mtime > STALE:
                path.unlink()
