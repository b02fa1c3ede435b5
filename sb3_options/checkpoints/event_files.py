"""Cuts TensorBoard's files to their length at a checkpoint, so that no point is logged twice."""

from __future__ import annotations

import os
from pathlib import Path

from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

PATTERN = "*tfevents*"


def sizes(logger: Logger) -> dict[str, int]:
    """Bytes of each event file of a logger, by name, with everything that was logged in them."""
    for output in logger.output_formats:
        if isinstance(output, TensorBoardOutputFormat):
            output.writer.flush()
    return {file.name: file.stat().st_size for file in _files(logger)}


def cut(logger: Logger, before: dict[str, int]) -> None:
    """Remove the points that ended processes logged after a checkpoint."""
    files = _files(logger)
    if not any(file.name in before for file in files):
        return  # the logger writes to another folder than before: nothing in it is touched
    own = {
        Path(output.writer.file_writer.event_writer._file_name).name  # type: ignore[attr-defined]  # a writer that was not closed has it
        for output in logger.output_formats
        if isinstance(output, TensorBoardOutputFormat)
    }
    for file in files:
        if file.name in before:
            os.truncate(file, min(before[file.name], file.stat().st_size))
        elif file.name not in own:
            file.unlink()


def _files(logger: Logger) -> list[Path]:
    has_any = any(isinstance(output, TensorBoardOutputFormat) for output in logger.output_formats)
    return sorted(Path(logger.dir).glob(PATTERN)) if has_any and logger.dir is not None else []
