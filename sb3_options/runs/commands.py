"""What each command of the command line takes."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Literal

from sb3_options.checked import settings
from sb3_options.runs.config import Count

EVAL_SEED = 10_000
"""Evaluation environments count their seeds from here, so that none equals a training seed."""


@settings
class DemoConfig:
    """Show the gain: discover an option in one task, then learn a harder task with it and without it.

    Both agents have the same algorithm (MaskablePPO), settings and seeds.

    Attributes:
        task: "rooms" and "key" (a locked door) take two minutes, "minigrid" ten.
        out: Folder for the table and the picture.
        seeds: Number of repetitions.
        seed: Random seed of the first.
        video: Film both agents of the first seed side by side.
        progress: Show a progress bar.
    """

    task: Literal["rooms", "key", "minigrid"] = "rooms"
    out: Path = Path("runs/demo")
    seeds: Count = 3
    seed: int = 0
    video: bool = False
    progress: bool = True


@settings
class Trusting:
    """Settings that import a module: the file of a run is not trusted with them.

    Attributes:
        env: Environment, module:Id, where the run had such a one; evaluate takes any.
        env_wrapper: Wrapper for it, module:Class, where the run had one.
        feature_map: Feature map φ, module:function, where the run had one.
    """

    env: str | None = field(default=None, kw_only=True)
    env_wrapper: str | None = field(default=None, kw_only=True)
    feature_map: str | None = field(default=None, kw_only=True)

    def trusted(self) -> dict[str, str | None]:
        """These settings by name."""
        return {name: getattr(self, name) for name in Trusting.__annotations__}


@settings
class EvaluateConfig(Trusting):
    """Load a run in a new process and act greedily: mean return, success rate and primitive steps an episode.

    Attributes:
        run: The run folder that training named.
        episodes: How many to play.
        seed: Of the environment.
        video: Write the first ten episodes to this file, MP4 or GIF.
        best: Play the best model of --eval-freq, not the last.
    """

    run: Path
    episodes: Count = 100
    seed: int = EVAL_SEED
    video: Path | None = None
    best: bool = False


@settings
class ResumeConfig(Trusting):
    """Go on with a run that was killed or interrupted, from its last checkpoint, as if it had never ended.

    Attributes:
        run: The run folder that training named.
        n_timesteps: Primitive steps in all; more than before lengthens a run, also a finished one.
        progress: Show a progress bar.
    """

    run: Path
    n_timesteps: int | None = None
    progress: bool = True


@settings
class CompareConfig:
    """Compare runs, or groups of runs, by their TensorBoard logs: a table and a picture.

    Attributes:
        runs: Run folders, or folders that hold some. Those that differ in their seed alone make a group; NAME=PATTERN
            makes a group by hand.
        out: The picture.
        reach: When a run has learned: "success", "return" or "length" and a value, at the first of two entries in a
            row that have it.
    """

    runs: tuple[str, ...]
    out: Path = Path("compare.png")
    reach: str = "success=0.9"


@settings
class TuneConfig(Trusting):
    """Search for settings of training with Optuna: a file says what stays (base) and what varies (search).

    Attributes:
        space: YAML file with base (settings) and search (name: [values] or {low, high, log}).
        out: Folder for trials, runs and best.yml. A search in it goes on.
        trials: Sets of settings to try, earlier ones included.
        seeds: Each is run on this many seeds, from 0. Judge it on others.
        reach: What is to be reached in the fewest primitive steps (mean of logarithms): success=0.9, return=1.5 or
            length=40; nothing that runs have from their start.
        jobs: Trials at a time.
    """

    space: Path
    out: Path = Path("tuned")
    trials: Count = 30
    seeds: Count = 3
    reach: str = "success=0.9"
    jobs: Count = 1


@settings
class InspectConfig:
    """Show the options of a run folder, an options file or a model.zip, without loading the model.

    Attributes:
        file: Which.
    """

    file: Path
