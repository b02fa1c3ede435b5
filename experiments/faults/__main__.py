"""What becomes of damaged files, full disks, killed worker processes, senseless input and long runs?

``python -m experiments.faults files|checkpoints|disk|fuzz|workers|memory|all --out FOLDER``. Interrupted, it goes on
with the part it was in.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.progress import track
from rich.table import Table

from experiments.common.machines import Machines
from experiments.common.seeds import Part, run_parts, write_json
from experiments.common.study import show, write
from experiments.faults import checkpoints, disk, files, fuzz, memory, workers
from experiments.faults.run_folder import run_folder
from sb3_options.runs import folder as runs

SETTINGS = {
    "files": ["n_files"],
    "checkpoints": ["n_files"],
    "disk": ["n_offsets"],
    "fuzz": ["n_bags", "n_settings"],
    "workers": ["n_worker_steps", "kill_every"],
    "memory": [],
}
"""What the results of each part depend on, beside the seed."""


@dataclass(frozen=True, kw_only=True)
class Study(Machines):
    """Damage files, fill disks, kill workers, pass nonsense, and train for long.

    Attributes:
        part: Which, or all.
        out: Folder for results.json and everything that is kept.
        n_files: How often each file, and a checkpoint, is damaged.
        n_offsets: Full disks for each kind of file, and for a training.
        n_bags: Fuzzed sets of bags.
        n_settings: Fuzzed configurations.
        n_timesteps: Of each long run.
        warm_up: Primitive steps of it after which memory is to grow no more.
        cases: Which long runs; of the others the results of an earlier command are kept.
        n_worker_steps: Of the run whose workers are killed, all workers together.
        kill_every: Seconds of training before a worker is killed.
        seed: Of the damages and the runs.
    """

    part: tyro.conf.Positional[Literal["all", "files", "checkpoints", "disk", "fuzz", "workers", "memory"]]
    out: Path
    n_files: int = 1000
    n_offsets: int = 50
    n_bags: int = 10_000
    n_settings: int = 2_000
    n_timesteps: int = memory.N_TIMESTEPS
    warm_up: int = memory.WARM_UP
    cases: tuple[str, ...] = tuple(memory.CASES)
    n_worker_steps: int = 1_600_000
    kill_every: float = 60.0
    seed: int = 1000


def main(study: Study) -> None:
    """Run the parts, and write and print what was found."""
    functions: dict[str, Callable[[Study], dict[str, Any]]] = {
        "files": _files,
        "checkpoints": _checkpoints,
        "disk": _disk,
        "fuzz": _fuzz,
        "workers": _workers,
        "memory": _memory,
    }
    found: dict[str, Any] = {}
    for name in SETTINGS:
        path = study.out / "parts" / f"{name}.json"
        if study.part in (name, "all"):
            settings = {key: getattr(study, key) for key in ("seed", *SETTINGS[name])}
            found[name] = functions[name](study) | {"settings": settings}
            write_json(path, found[name])
        elif path.is_file():
            found[name] = json.loads(path.read_text(encoding="utf-8"))
    write(study.out, {"command": "python -m experiments.faults all", **found}, {})
    show(*(_table(name, rows) for name, rows in found.items()), f"Results: {study.out / 'results.json'}")


def _files(study: Study) -> dict[str, Any]:
    run = run_folder(study.out / "run")
    random = np.random.default_rng(study.seed)
    names = (runs.OPTIONS, runs.MODEL)
    return {name: files.check(run.path / name, files.options_in, study.n_files, random) for name in names}


def _checkpoints(study: Study) -> dict[str, Any]:
    folder = checkpoints.folder_with_checkpoints(study.out / "run_with_checkpoints")
    return dict(checkpoints.check(folder, study.n_files, np.random.default_rng(study.seed)))


def _fuzz(study: Study) -> dict[str, Any]:
    return {
        "bags": fuzz.check_bags(study.n_bags, study.seed),
        "settings of": fuzz.check_settings(study.n_settings, study.seed),
    }


def _workers(study: Study) -> dict[str, Any]:
    return {workers.ALGO: workers.run(study.out / "workers", study.n_worker_steps, study.kill_every, study.seed)}


def _disk(study: Study) -> dict[str, Any]:
    run = run_folder(study.out / "run")
    kinds = disk.writers(run).items()
    found: dict[str, Any] = {
        name: disk.overwrite(name, save, study.n_offsets) for name, save in track(kinds, description="Full disks")
    }
    return found | {"training": disk.trainings(run, study.n_offsets)}


def _memory(study: Study) -> dict[str, Any]:
    """The chosen cases, beside what others were found to be before."""
    unknown = set(study.cases) - set(memory.CASES)
    if unknown:
        raise SystemExit(f"--cases: there is no {unknown.pop()!r}, choose from {', '.join(map(repr, memory.CASES))}.")
    folder, path = study.out / "memory", study.out / "parts" / "memory.json"
    before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    parts = [
        Part(
            name,
            partial(memory.run, name, study.n_timesteps, study.warm_up),
            folder / name.replace(" ", "_"),
        )
        for name in study.cases
    ]
    settings = {"n_timesteps": study.n_timesteps, "warm_up": study.warm_up}
    results = run_parts(parts, [study.seed], settings=settings, on=study, description="Long runs")
    return before | {name: runs_[0] for name, runs_ in results.items()}


def _table(part: str, rows: dict[str, Any]) -> Table:
    flat: dict[str, dict[str, Any]] = {}
    for name, row in rows.items():
        if name == "settings":
            continue
        if all(isinstance(cell, dict) for cell in row.values()):
            flat |= {f"{name}: {kind}": cells for kind, cells in row.items()}
        else:
            flat[name] = row
    columns = list(dict.fromkeys(column for cells in flat.values() for column in cells))
    table = Table(part, *columns)
    for name, cells in flat.items():
        table.add_row(name, *(_shown(cells.get(column, "")) for column in columns))
    return table


def _shown(value: Any) -> str:
    if isinstance(value, list | dict):
        return str(len(value))
    return f"{value:.1f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main(tyro.cli(Study))
