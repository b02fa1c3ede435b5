"""Settings of each command of the command line."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Literal

from sb3_options.checked import settings
from sb3_options.runs.config import Count

EVAL_SEED = 10_000  # evaluation environments count their seeds from here, so that none equals a training seed


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
        progress: Whether to show a progress bar.
    """

    task: Literal["rooms", "key", "minigrid"] = "rooms"
    out: Path = Path("runs/demo")
    seeds: Count = 3
    seed: int = 0
    video: bool = False
    progress: bool = True


@settings
class Trusting:
    """Settings that import a module. A run's own file is not trusted with them.

    Attributes:
        env: Environment, module:Id, if the run had such an id; evaluate takes any.
        env_wrapper: Wrapper for it, module:Class, if the run had one.
        feature_map: Feature map φ, module:function, if the run had one.
    """

    env: str | None = field(default=None, kw_only=True)
    env_wrapper: str | None = field(default=None, kw_only=True)
    feature_map: str | None = field(default=None, kw_only=True)

    def trusted(self) -> dict[str, str | None]:
        """These settings by name."""
        return {name: getattr(self, name) for name in Trusting.__annotations__}


@settings
class EvaluateConfig(Trusting):
    """Play a run in a new process: mean return, success rate and primitive steps per episode.

    Attributes:
        run: Run folder.
        episodes: Number of episodes.
        seed: Random seed of the environment.
        video: Write the first ten episodes to this file, MP4 or GIF.
        best: Play the best model of --eval-freq, not the last.
        stochastic: Sample the policy's actions, as in training. By default it acts greedily.
    """

    run: Path
    episodes: Count = 100
    seed: int = EVAL_SEED
    video: Path | None = None
    best: bool = False
    stochastic: bool = False


@settings
class ResumeConfig(Trusting):
    """Continue a run that was killed or interrupted, from its last checkpoint, as if it had never stopped.

    Attributes:
        run: Run folder.
        n_timesteps: Primitive steps in total. A larger number than before lengthens a run, even a finished one.
        progress: Whether to show a progress bar.
    """

    run: Path
    n_timesteps: int | None = None
    progress: bool = True


@settings
class CompareConfig:
    """Compare runs, or groups of runs, by their TensorBoard logs: a table and a picture.

    Attributes:
        runs: Run folders, or folders that hold run folders. Runs that differ only in their seed make a group.
            NAME=PATTERN names a group.
        out: File of the picture.
        reach: What counts as learned: success=0.9, return=1.5 or length=40, in two log entries in a row.
    """

    runs: tuple[str, ...]
    out: Path = Path("compare.png")
    reach: str = "success=0.9"


@settings
class TuneConfig(Trusting):
    """Search for settings of training with Optuna. A file names fixed settings (base) and the search space (search).

    Attributes:
        space: YAML file with base (settings) and search (name: [values] or {low, high, log}).
        out: Folder for trials, runs and best.yml. A search in it continues.
        trials: Number of sets of settings to try, earlier ones included.
        seeds: Number of seeds for each set, from 0. Judge the best one on other seeds.
        reach: Goal to be reached in the fewest primitive steps (mean of logarithms): success=0.9, return=1.5 or
            length=40. Runs must not have it at their start.
        jobs: Number of trials at a time.
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
        file: Run folder, options file or model.zip.
    """

    file: Path
