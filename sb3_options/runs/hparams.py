"""The settings of a run as TensorBoard's HParams tab shows them beside its results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from sb3_options.runs.config import HOW_IT_RAN, TrainConfig


def hparams_of(config: TrainConfig, options: Path | None) -> dict[str, Any]:
    """All settings that may matter, by name.

    Args:
        config: Of the run.
        options: What it started with, also where it is resumed and has them from the checkpoint. The last two parts of
            the path are told, because run folders are moved.
    """
    settings: dict[str, Any] = TypeAdapter(type(config)).dump_python(config, mode="json")
    settings["options"] = None if options is None else "/".join(options.parts[-2:])
    return {name: value for name, value in settings.items() if name not in HOW_IT_RAN}
