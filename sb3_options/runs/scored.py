"""A run of ``train`` in a process of its own, and how good it was."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from sb3_options.atomic import atomic_write
from sb3_options.runs import config as configs
from sb3_options.runs.compare import Goal, at_the_end
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.logged import Run, read_run
from sb3_options.runs.users_code import flag

Objective = Literal["steps", "end"]
SETTINGS, SCORE, LOG = "settings.yml", "score.json", "output.txt"


class RunFailedError(RuntimeError):
    """A run has failed; the text says how."""


class Processes:
    """Runs trainings for several threads, and ends them all at once."""

    def __init__(self) -> None:
        self.ended = False
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()

    def run(self, command: list[str], log: Path) -> int:
        """The exit status of a command, whose output goes to ``log``.

        Raises:
            KeyboardInterrupt: `end` was called.
        """
        with log.open("wb") as output:
            with self._lock:
                if self.ended:
                    raise KeyboardInterrupt
                # In a session of its own an interrupt does not reach it: it would save, and end as if it were done.
                process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)
                self._running.add(process)
            try:
                status = process.wait()
            finally:
                with self._lock:
                    self._running.discard(process)
                if process.poll() is None:  # an interrupt came while this waited
                    process.kill()
                    process.wait()
        if self.ended:
            raise KeyboardInterrupt
        return status

    def end(self) -> None:
        """End what runs, and let nothing begin any more."""
        with self._lock:
            self.ended = True
            for process in self._running:
                process.kill()


def score(
    run: TrainConfig, goal: Goal, objective: Objective, trusted: Mapping[str, str | None], processes: Processes
) -> float:
    """Train once, unless that was done, and read how good it was.

    Args:
        run: Its ``tensorboard_log`` is a folder for this run alone.
        goal: Of `score_of`.
        objective: Likewise.
        trusted: What may import modules, by the name of the setting, as the user has named it.
        processes: Train it.

    Raises:
        RunFailedError: Training failed, or logged nothing that can be scored.
        KeyboardInterrupt: The processes were ended.
    """
    folder = run.tensorboard_log
    if (folder / SCORE).is_file():
        return float(json.loads((folder / SCORE).read_text(encoding="utf-8"))["score"])
    folder.mkdir(parents=True, exist_ok=True)
    before = set(folder.glob("*/*/"))  # of a search that was killed
    configs.save(dataclasses.replace(run, checkpoint_freq=0), folder / SETTINGS)  # it is short, and tried again
    words = ["--config", str(folder / SETTINGS), "--no-progress"]
    for name, value in trusted.items():
        words += [] if value is None else [flag(name), value]
    status = processes.run([sys.executable, "-m", "sb3_options", "train", run.algo, *words], folder / LOG)
    if status != 0:
        said = (folder / LOG).read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise RunFailedError(" ".join([*said[-1:], f"Its output is in {folder / LOG}."]))
    try:
        (made,) = set(folder.glob("*/*/")) - before
        found = score_of(read_run(made), goal, objective, run.n_timesteps)
    except (ValueError, OSError) as error:
        raise RunFailedError(str(error)) from error
    with atomic_write(folder / SCORE) as temporary:
        temporary.write_text(json.dumps({"score": found}), encoding="utf-8")
    return found


def score_of(run: Run, goal: Goal, objective: Objective, n_timesteps: int) -> float:
    """How good a run was.

    Args:
        run: What it logged; evaluations count, if it made any.
        goal: What is waited for, or whose end counts.
        objective: ``steps`` or ``end``.
        n_timesteps: Of the whole run, which one that never reaches the goal counts with.

    Returns:
        The logarithm of the primitive steps to the goal; or the measure's mean over the last tenth of training.

    Raises:
        ValueError: The run did not log it.
    """
    source = "eval" if run.curves["eval"] else "rollout"
    if goal.measure not in run.curves[source]:
        raise ValueError(f"{run.folder} did not log {goal.measure}: choose --reach {', '.join(run.curves[source])}.")
    curve = run.curves[source][goal.measure]
    if objective == "end":
        return at_the_end(curve, n_timesteps)
    at = goal.reached(curve)
    return math.log(max(1.0, n_timesteps if at is None else curve.steps[at]))
