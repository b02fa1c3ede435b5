"""What two runs left, compared; only what the clock says may differ."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.save_util import load_from_zip_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

import sb3_options.callbacks  # noqa: F401  # makes known what a checkpoint may contain
from experiments.kills.states import OF_THE_CLOCK, differing
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.checkpoints.tree import encode
from sb3_options.options import file as option_file
from sb3_options.runs import folder as runs


def differences(one: Path, other: Path) -> dict[str, list[str]]:
    """Where the folders of two finished runs differ, by what was compared; empty lists where they are equal."""
    return {
        "weights and optimizer": _of_models(one, other),
        "options": _of_options(one, other),
        "monitor files": _monitor_rows(one, other),
        "TensorBoard": _of_scalars(one, other),
        "texts and settings": _of_texts(one, other),
        "evaluations": _of_evaluations(one, other),
        **of_checkpoints(one, other),
    }


def _of_options(one: Path, other: Path) -> list[str]:
    """By content, for safetensors writes its text entries in any order."""
    file, file_other = (option_file.opened(folder / runs.OPTIONS) for folder in (one, other))
    arrays, others = file.tensors, file_other.tensors
    names = arrays.keys() | others.keys()
    differ = [n for n in names if n not in arrays or n not in others or arrays[n].tobytes() != others[n].tobytes()]
    return sorted(differ) + ["other entries"] * (file[1:6] != file_other[1:6])


def _of_models(one: Path, other: Path) -> list[str]:
    a, b = (load_from_zip_file(folder / runs.MODEL, load_data=False)[1] for folder in (one, other))
    first, second = (encode(_plain(each)) for each in (a, b))
    if first[0] != second[0]:
        return ["other parameters"]
    return [
        f"array {name} of {array.shape}"
        for name, array in first[1].items()
        if array.tobytes() != second[1][name].tobytes()
    ]


def _plain(value: Any) -> Any:
    """Ordered dictionaries as dictionaries."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    return value.clone() if isinstance(value, torch.Tensor) else value


def _monitor_rows(one: Path, other: Path) -> list[str]:
    """Files whose returns and lengths of episodes differ; their third column is the clock's."""

    def rows(file: Path) -> list[list[str]]:
        return [line.split(",")[:2] for line in file.read_text(encoding="utf-8").splitlines()[1:]]

    files = {file.name for folder in (one, other) for file in (folder / runs.MONITOR).iterdir()}
    return sorted(n for n in files if rows(one / runs.MONITOR / n) != rows(other / runs.MONITOR / n))


def _of_scalars(one: Path, other: Path) -> list[str]:
    a, b = scalars(one), scalars(other)
    return sorted(tag for tag in a.keys() | b.keys() if a.get(tag) != b.get(tag))


def scalars(run: Path) -> dict[str, list[tuple[int, float]]]:
    """Steps and values of every TensorBoard scalar of a run, in the order in which they were written."""
    points: dict[str, list[tuple[int, float]]] = {}
    for folder in sorted(run.glob("tensorboard_*")):
        events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
        events.Reload()
        for tag in set(events.Tags()["scalars"]) - OF_THE_CLOCK:
            points.setdefault(f"{folder.name}/{tag}", []).extend((e.step, e.value) for e in events.Scalars(tag))
    return points


def _of_texts(one: Path, other: Path) -> list[str]:
    a, b = texts(one), texts(other)
    return sorted(tag for tag in a.keys() | b.keys() if a.get(tag) != b.get(tag))


def texts(run: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Steps and contents of every TensorBoard text of a run, and its settings for the HParams tab."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    for folder in sorted(run.glob("tensorboard_*")):
        events = EventAccumulator(str(folder), size_guidance={"tensors": 0})
        events.Reload()
        for tag in events.Tags()["tensors"]:
            told = [(event.step, b"".join(event.tensor_proto.string_val)) for event in events.Tensors(tag)]
            found[f"{folder.name}/{tag}"] = told
        with suppress(KeyError):  # there are none
            for tag, content in events.PluginTagToContent("hparams").items():
                settings = HParamsPluginData.FromString(content)  # a map's bytes have no order of their own
                found[f"{folder.name}/{tag}"] = [(0, settings.SerializeToString(deterministic=True))]
    return found


def _of_evaluations(one: Path, other: Path) -> list[str]:
    a, b = (dict(np.load(f / "evaluations.npz")) if (f / "evaluations.npz").is_file() else {} for f in (one, other))
    return sorted(n for n in a.keys() | b.keys() if n not in a or n not in b or not np.array_equal(a[n], b[n]))


def of_checkpoints(one: Path, other: Path) -> dict[str, list[str]]:
    """Where the last checkpoints differ: everything that training is."""
    (first, a), (second, b) = (CheckpointFolder(folder / runs.CHECKPOINTS).newest() for folder in (one, other))
    differ = [f"{first.name} and {second.name}"] if first.name != second.name else differing(a, b)
    return {"last checkpoint": differ}
