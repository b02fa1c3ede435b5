"""What each command of the command line takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

EVAL_SEED = 10_000
"""Evaluation environments count their seeds from here, so that none equals a training seed."""


@dataclass(frozen=True)
class DemoConfig:
    """Show the gain: discover an option in one task, then learn a harder task with it and without it.

    Both agents have the same algorithm (MaskablePPO), settings and seeds.

    Attributes:
        task: "rooms" and "key" (a locked door) take two minutes, "minigrid" ten.
        out: Folder for the table, the picture and the film.
        seeds: Number of repetitions.
        seed: Random seed of the first.
        video: Film both agents of the first seed side by side.
        progress: Show a progress bar.
    """

    task: Annotated[Literal["rooms", "key", "minigrid"], tyro.conf.Positional] = "rooms"
    out: Path = Path("runs/demo")
    seeds: int = 3
    seed: int = 0
    video: bool = False
    progress: bool = True


@dataclass(frozen=True, kw_only=True)
class Trusting:
    """Settings that import a module: the file of a run is not trusted with them.

    Attributes:
        env: Environment, module:Id, where the run had such a one; evaluate takes any.
        env_wrapper: Wrapper for it, module:Class, where the run had one.
        feature_map: Feature map φ, module:function, where the run had one.
    """

    env: str | None = None
    env_wrapper: str | None = None
    feature_map: str | None = None

    def trusted(self) -> dict[str, str | None]:
        """These settings by name."""
        return {"env": self.env, "env_wrapper": self.env_wrapper, "feature_map": self.feature_map}


@dataclass(frozen=True)
class EvaluateConfig(Trusting):
    """Load a run in a new process and act greedily: mean return, success rate and primitive steps an episode.

    Attributes:
        run: The run folder that training named.
        episodes: How many to play.
        seed: Of the environment.
        video: Write the first ten episodes to this file, MP4 or GIF.
        best: Play the best model of --eval-freq, not the last.
    """

    run: Annotated[Path, tyro.conf.Positional]
    episodes: int = 100
    seed: int = EVAL_SEED
    video: Path | None = None
    best: bool = False


@dataclass(frozen=True)
class ResumeConfig(Trusting):
    """Go on with a run that was killed or interrupted, from its last checkpoint, as if it had never ended.

    Attributes:
        run: The run folder that training named.
        n_timesteps: Primitive steps in all; more than before lengthens a run, also a finished one.
        progress: Show a progress bar.
    """

    run: Annotated[Path, tyro.conf.Positional]
    n_timesteps: int | None = None
    progress: bool = True


@dataclass(frozen=True)
class CompareConfig:
    """Compare runs, or groups of runs, by their TensorBoard logs: a table and a picture.

    Attributes:
        runs: Run folders, or folders that hold some. Those that differ in their seed alone make a group; NAME=PATTERN
            makes a group by hand.
        out: The picture.
        reach: When a run has learned: "success", "return" or "length" and a value, at the first of two entries in a
            row that have it.
    """

    runs: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    out: Path = Path("compare.png")
    reach: str = "success=0.9"


@dataclass(frozen=True)
class TuneConfig(Trusting):
    """Search for settings of training with Optuna: a file says what stays (base) and what varies (search).

    Attributes:
        space: YAML file with ``base`` (settings) and ``search`` (name: [values] or {low, high, log}).
        out: Folder for trials, runs and best.yml. A search in it goes on.
        trials: Sets of settings to try, earlier ones included.
        seeds: Each is run on this many seeds, from 0, or until it proves worse than the best. Judge it on others.
        objective: "steps": fewest primitive steps to --reach, mean of logarithms; "end": best of the measure of
            --reach over the last tenth of training.
        reach: As of ``compare``: success=0.9, return=1.5 or length=40; nothing that runs have from their start.
        jobs: Trials at a time.
        cluster: Train on the Ray cluster at HOST:PORT, or "auto". All machines share the folder.
    """

    space: Annotated[Path, tyro.conf.Positional]
    out: Path
    trials: int = 30
    seeds: int = 3
    objective: Literal["steps", "end"] = "steps"
    reach: str = "success=0.9"
    jobs: int = 1
    cluster: str | None = None


@dataclass(frozen=True)
class InspectConfig:
    """Show the options of a run folder, an options file or a model.zip, without loading the model.

    Attributes:
        file: Which.
    """

    file: Annotated[Path, tyro.conf.Positional]
