"""Logs that cannot be written, on a full disk say, end no training: there is a warning, and it goes on without them."""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor

logger = logging.getLogger("sb3_options")


class Tolerance:
    """Takes the `OSError` of what writes one file, and warns of the first.

    Args:
        what: The file.
        for_good: Whether nothing more is tried after the first.
    """

    def __init__(self, what: str | os.PathLike[str], *, for_good: bool = False) -> None:
        self.what, self.for_good = what, for_good
        self.failed = False

    def tolerant(self, write: Callable[..., Any], *, always: bool = False) -> Callable[..., None]:
        """The function ``write``, which ends in no error and returns nothing; ``always`` tries it all the same."""

        def attempt(*args: Any, **kwargs: Any) -> None:
            if self.failed and self.for_good and not always:
                return
            try:
                write(*args, **kwargs)
            except OSError as error:
                if not self.failed:
                    _warn(self.what, error)
                self.failed = True

        return attempt


@contextmanager
def without(what: str | os.PathLike[str]) -> Iterator[None]:
    """Let a file that cannot be written be missing, with a warning that names it.

    Args:
        what: The file.
    """
    try:
        yield
    except OSError as error:
        _warn(what, error)


def keep_monitor(env: gym.Env[Any, Any]) -> None:
    """Let the environment step on where the file of its ``Monitor`` cannot be written.

    Rows that could not be written stay in the file's buffer and are written with the next one that can be. The user is
    warned once.

    Args:
        env: A ``Monitor``, or anything else, which is let be.
    """
    if isinstance(env, Monitor) and env.results_writer is not None:
        writer = env.results_writer
        file: Any = writer.file_handler  # a text file, which typeshed does not say

        def close() -> None:
            with closing(file.buffer.raw):  # which stays open where its buffer cannot be written
                file.close()

        tolerance = Tolerance(file.name)
        writer.write_row = tolerance.tolerant(writer.write_row)  # type: ignore[method-assign]  # it takes the same
        writer.close = tolerance.tolerant(close)  # type: ignore[method-assign]  # likewise


def begin_monitors(folder: Path, n_envs: int, env_id: str) -> None:
    """Write the heads of the files of ``Monitor`` that are not there yet, for monitors that only append to them.

    Args:
        folder: Of the files.
        n_envs: How many.
        env_id: For the heads.
    """
    folder.mkdir(parents=True, exist_ok=True)
    head = f"#{json.dumps({'t_start': time.time(), 'env_id': env_id})}\nr,l,t\n"
    for i in range(n_envs):
        path = folder / f"{i}.{Monitor.EXT}"
        if not path.exists():
            path.write_text(head, encoding="utf-8")


def go_on_counting(env: gym.Env[Any, Any]) -> None:
    """Let a ``Monitor`` that appends to a file count its seconds from where the head of the file says.

    Args:
        env: A ``Monitor``, or anything else, which is let be.
    """
    if isinstance(env, Monitor) and env.results_writer is not None:
        with Path(env.results_writer.file_handler.name).open(encoding="utf-8") as file:
            head = file.readline()
        if head.startswith("#"):  # on a machine that shares no folder there is no head
            env.t_start = float(json.loads(head[1:])["t_start"])


class KeepTraining(BaseCallback):
    """Goes on training where TensorBoard's file cannot be written; the user is warned once.

    From then on nothing is written to that file: a record that is cut off ends what TensorBoard reads of it.
    """

    def _on_training_start(self) -> None:
        for output in self.logger.output_formats:
            if isinstance(output, TensorBoardOutputFormat):
                once = Tolerance(f"TensorBoard's file in {output.writer.log_dir}", for_good=True)
                output.write = once.tolerant(output.write)  # type: ignore[method-assign]  # it takes the same
                output.close = once.tolerant(output.close, always=True)  # type: ignore[method-assign]  # likewise
                # The thread that writes would print its own traceback. Where there is no such thread, none does.
                with suppress(AttributeError):
                    writer: Any = output.writer.file_writer  # typed as None before it is made
                    records = writer.event_writer._async_writer._writer
                    for name in ("write", "flush", "close"):
                        setattr(records, name, once.tolerant(getattr(records, name), always=name == "close"))

    def _on_step(self) -> bool:
        return True


def _warn(what: str | os.PathLike[str], error: OSError) -> None:
    logger.warning("%s could not be written, and training goes on without it: %s", os.fspath(what), error)
