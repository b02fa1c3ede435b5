"""What a search for settings is asked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class TuneConfig:
    """Search for settings of training with Optuna: a file says what stays (base) and what varies (search).

    Attributes:
        space: YAML file with ``base`` (settings) and ``search`` (name: [values] or {low, high, log}).
        out: Folder for trials, runs, pictures and best.yml. A search that is there goes on; several may work in it.
        trials: How many sets of settings are tried, those that are there included.
        seeds: Each is run on this many seeds, or until it proves worse than the best.
        first_seed: Seeds count up from here. Judge what was chosen on others.
        objective: "steps": fewest primitive steps to what --reach says, mean of logarithms; "end": best of what --reach
            names over the last tenth of training.
        reach: As of ``compare``: success=0.9, return=1.5 or length=40; nothing that runs have from their start.
        jobs: Trials at a time.
        cluster: Train on the Ray cluster at HOST:PORT, or "auto": of this machine, or of the variable RAY_ADDRESS.
            All machines share the folder.
        worker: Number of this command, where several work in one folder, so that they propose differently.
        env: Environment, module:Id, where the file names such a one.
        env_wrapper: Wrapper for it, module:Class; likewise.
        feature_map: Feature map φ, module:function; likewise.
    """

    space: Annotated[Path, tyro.conf.Positional]
    out: Path
    trials: int = 30
    seeds: int = 3
    first_seed: int = 0
    objective: Literal["steps", "end"] = "steps"
    reach: str = "success=0.9"
    jobs: int = 1
    cluster: str | None = None
    worker: int = 0
    env: str | None = None
    env_wrapper: str | None = None
    feature_map: str | None = None

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        for name, least in {"trials": 1, "seeds": 1, "first_seed": 0, "jobs": 1, "worker": 0}.items():
            if getattr(self, name) < least:
                flag = name.replace("_", "-")
                raise ValueError(f"--{flag} must be at least {least}, got {getattr(self, name)}.")
