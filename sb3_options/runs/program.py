"""What to type for the program that runs."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

SCRIPT = "sb3-options"


def program_name() -> str:
    """``sb3-options`` where that was called, or ``python -m sb3_options``; else ``train.py``."""
    return SCRIPT if Path(sys.argv[0]).stem in (SCRIPT, "__main__") else "train.py"


def python() -> str:
    """What to type for this interpreter: it may be in a virtual environment that nobody activated."""
    return "python" if shutil.which("python") == sys.executable else quoted(sys.executable)


def command() -> str:
    """What to type before a command. A run may be started from another folder, or by a script outside the path."""
    called = Path(sys.argv[0])
    if called.stem == SCRIPT:
        return SCRIPT if shutil.which(SCRIPT) == str(called.absolute()) else quoted(called)
    if called.stem == "__main__":
        return f"{python()} -m sb3_options"
    return f"{python()} {quoted(called.absolute()) if called.name == 'train.py' else 'train.py'}"


def quoted(path: Path | str) -> str:
    """A path for the shell, relative where that is shorter."""
    return shlex.quote(min(str(path), os.path.relpath(path), key=len))
