"""Running a function once per seed: in parallel, on one machine or many, with progress, and resumable."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rich.progress import track

from experiments.common.machines import Machines, finished
from sb3_options.atomic import atomic_write

Result = dict[str, Any]
HERE = Machines()


def write_json(path: Path, content: Any) -> None:
    """Write JSON that is there whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class Part:
    """A part of a study that is run once per seed.

    Attributes:
        name: Its name.
        function: Seed → a result that JSON can hold. Runs in a process of its own, with one torch thread.
        out: Folder for its results, one file a seed.
        settings: What its results depend on beside those of all parts.
    """

    name: str
    function: Callable[[int], Result]
    out: Path
    settings: Mapping[str, Any] = field(default_factory=dict)


def run_parts(
    parts: Sequence[Part],
    seeds: Sequence[int],
    *,
    settings: Mapping[str, Any],
    on: Machines = HERE,
    description: str = "Seeds",
) -> dict[str, list[Result]]:
    """Results of every part for every seed, in their order.

    Each result is kept in ``out/seeds/SEED.json`` as soon as it is there, and a seed whose file is there with the
    same settings is not run again. All parts share the processes, so that a slow seed of one holds up no other. They
    take turns seed by seed, so that processor times of one seed are measured under the same load.

    Args:
        parts: Which.
        seeds: Which.
        settings: What a result depends on beside the seed; a part may have more of them.
        on: Where they run; on a cluster, too, the files are written here.
        description: Beside the progress bar.

    Returns:
        The results by name.
    """
    plain = {part.name: json.loads(json.dumps({**settings, **part.settings}, default=str)) for part in parts}
    results: dict[tuple[str, int], Result] = {}
    for part in parts:
        for seed in seeds:
            path = _path(part.out, seed)
            kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
            if kept.get("settings") == plain[part.name]:
                results[part.name, seed] = kept["result"]
    missing = [(part, seed) for seed in seeds for part in parts if (part.name, seed) not in results]
    ended = finished([partial(part.function, seed) for part, seed in missing], on)
    for i, result in track(ended, description=description, total=len(missing), disable=not missing):
        part, seed = missing[i]
        results[part.name, seed] = result
        write_json(_path(part.out, seed), {"settings": plain[part.name], "result": result})
    return {part.name: [results[part.name, seed] for seed in seeds] for part in parts}


def run_seeds(
    function: Callable[[int], Result],
    seeds: Sequence[int],
    out: Path,
    *,
    settings: Mapping[str, Any],
    on: Machines = HERE,
    description: str = "Seeds",
) -> list[Result]:
    """Results of one function for every seed, in their order: `run_parts` of a single part."""
    part = Part("", function, out)
    return run_parts([part], seeds, settings=settings, on=on, description=description)[""]


def _path(out: Path, seed: int) -> Path:
    return out / "seeds" / f"{seed}.json"
