"""New Python processes that need not import the libraries again.

Importing torch and Stable-Baselines3 takes a process seconds of processor time. Python's fork server imports them once;
each process that it makes has them, and has imported nothing of this project: what `python` runs there meets the same
modules as in a process started from a shell. Worker processes of ``SubprocVecEnv`` come from the same server.
"""

import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from multiprocessing import get_context, set_forkserver_preload
from pathlib import Path

HANGING = 600  # seconds after which a process counts as hanging. No test may take so long, however busy the machine.

LIBRARIES = [
    *("gymnasium", "matplotlib.figure", "pydantic", "safetensors.numpy", "sb3_contrib", "scipy.stats"),
    *("stable_baselines3", "torch", "torch.utils.tensorboard"),
]
"""What the fork server imports; what is not installed is left out."""


def share_libraries() -> None:
    """Let every process that the fork server makes from now on have the libraries."""
    set_forkserver_preload(LIBRARIES)


def python(
    *arguments: str, cwd: Path | None = None, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run ``python ARGUMENTS`` in a new process: ``-c CODE``, ``-m MODULE …`` or ``FILE …``.

    ``env`` changes its environment. The result is that of ``subprocess.run``.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("stdout", "stderr")]
        process = get_context("forkserver").Process(
            target=_run, args=(arguments, str(cwd or Path.cwd()), dict(env or {}), files)
        )
        process.start()
        process.join(HANGING)
        if process.exitcode is None:
            process.kill()
            process.join()
        output, errors = (file.read_text(encoding="utf-8") if file.exists() else "" for file in files)
    assert process.exitcode is not None
    return subprocess.CompletedProcess(["python", *arguments], process.exitcode, output, errors)


def _run(arguments: tuple[str, ...], cwd: str, env: dict[str, str], files: list[Path]) -> None:
    """Be the interpreter."""
    for descriptor, file in zip((1, 2), files, strict=True):
        opened = os.open(file, os.O_WRONLY | os.O_CREAT)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.environ.update(env)
    os.chdir(cwd)
    sys.path[:0] = env.get("PYTHONPATH", "").split(os.pathsep) if "PYTHONPATH" in env else []
    first, *rest = arguments
    if first == "-c":
        sys.argv = ["-c", *rest[1:]]
        exec(compile(rest[0], "<string>", "exec"), {"__name__": "__main__"})
    elif first == "-m":
        sys.argv = [rest[0], *rest[1:]]
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv = [first, *rest]
        sys.path.insert(0, str(Path(first).parent))
        runpy.run_path(first, run_name="__main__")
