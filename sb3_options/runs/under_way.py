"""Whether a run is being trained, so that no two processes write to one run folder."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCK = ".training"
"""File in the run folder; it is removed when training ends."""


@contextmanager
def held(run: Path) -> Iterator[None]:
    """Keep other processes from training in a run folder. A process that is killed keeps none from it any more.

    Where the file system has no locks, nothing is kept.
    """
    descriptor = os.open(run / LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
    try:
        if not _locked(descriptor):
            raise ValueError(f"{run} is being trained by another process: wait until it has ended, or end it.")
        try:
            yield
        finally:
            with suppress(OSError):  # the folder may be gone, and Windows removes no file that is open
                (run / LOCK).unlink()
    finally:
        os.close(descriptor)


def _locked(descriptor: int) -> bool:
    """Lock an open file until it is closed; False where another process has."""
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass  # this file system has none
    # Who had it may have removed the file in between.
    return os.fstat(descriptor).st_nlink > 0
