"""Running a function once per seed: in parallel, with progress, and resumable."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed
from rich.progress import track

import sb3_options.envs  # noqa: F401  # registers them, in worker processes too
from sb3_options.atomic import whole_file

Result = dict[str, Any]


def write_json(path: Path, content: Any) -> None:
    """Write JSON that is there whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def run_seeds(
    function: Callable[[int], Result],
    seeds: Sequence[int],
    out: Path,
    *,
    settings: Mapping[str, Any],
    jobs: int | None = None,
    description: str = "Seeds",
) -> list[Result]:
    """Results of ``function`` for every seed, in their order.

    Each result is kept in ``out/seeds/SEED.json`` as soon as it is there, and a seed whose file is there with the
    same settings is not run again.

    Args:
        function: Seed → a result that JSON can hold. Runs in a process of its own, with one torch thread.
        seeds: Which.
        out: The study's folder.
        settings: What a result depends on beside the seed.
        jobs: Processes; by default as many as there are cores.
        description: Beside the progress bar.

    Returns:
        The results.
    """
    plain = json.loads(json.dumps(settings, default=str))
    results: dict[int, Result] = {}
    for seed in seeds:
        path = _path(out, seed)
        kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        if kept.get("settings") == plain:
            results[seed] = kept["result"]
    missing = [seed for seed in seeds if seed not in results]
    parallel = Parallel(n_jobs=jobs or os.cpu_count(), return_as="generator_unordered")
    finished = parallel(delayed(_single_threaded)(function, seed) for seed in missing)
    for seed, result in track(finished, description=description, total=len(missing), disable=not missing):
        results[seed] = result
        write_json(_path(out, seed), {"settings": plain, "result": result})
    return [results[seed] for seed in seeds]


def _single_threaded(function: Callable[[int], Result], seed: int) -> tuple[int, Result]:
    import torch

    torch.set_num_threads(1)
    return seed, function(seed)


def _path(out: Path, seed: int) -> Path:
    return out / "seeds" / f"{seed}.json"
