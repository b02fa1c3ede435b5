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
from typing import Any, Literal

from sb3_options.atomic import atomic_write
from sb3_options.execution.ray_cluster import connect
from sb3_options.runs import config as configs
from sb3_options.runs.compare import Goal, at_once, at_the_end
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.logged import NothingLoggedError, Run, no_episode_ended, read_run
from sb3_options.runs.users_code import flag

RETRIES = 10
"""How often a training begins again whose machine was lost."""

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


class ClusterProcesses(Processes):
    """The same on the machines of a Ray cluster, each in a task that takes one core.

    Where its machine is lost, a training begins again elsewhere. All machines share the folders that it names.

    Args:
        address: As `connect` takes it.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: There is no such cluster.
    """

    def __init__(self, address: str) -> None:
        super().__init__()
        self._ray = connect(address)
        self._tasks: set[Any] = set()
        self._run = self._ray.remote(_run_there).options(num_cpus=1, max_retries=RETRIES, scheduling_strategy="SPREAD")

    def run(self, command: list[str], log: Path) -> int:
        """The exit status of a command, whose interpreter is that of the other machine.

        Raises:
            KeyboardInterrupt: `end` was called.
            RunFailedError: It was lost time and again with its machine.
        """
        with self._lock:
            if self.ended:
                raise KeyboardInterrupt
            task = self._run.remote(command[1:], log.absolute(), Path.cwd())
            self._tasks.add(task)
        try:
            return int(self._ray.get(task))
        except self._ray.exceptions.RayError as error:
            if self.ended:
                raise KeyboardInterrupt from None
            raise RunFailedError(f"Ray could not run it: {str(error).strip().splitlines()[-1]}") from error
        finally:
            with self._lock:
                self._tasks.discard(task)

    def end(self) -> None:
        """End what runs, and let nothing begin any more."""
        super().end()
        with self._lock:
            for task in self._tasks:
                self._ray.cancel(task)


def _run_there(arguments: list[str], log: Path, folder: Path) -> int:
    with log.open("wb") as output:
        process = subprocess.Popen([sys.executable, *arguments], stdout=output, stderr=subprocess.STDOUT, cwd=folder)
        try:
            return process.wait()
        finally:
            if process.poll() is None:  # it is not waited for any more
                process.kill()
                process.wait()


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
    new = set(folder.glob("*/*/")) - before
    if not new:
        raise RunFailedError(f"Training left no run folder. Its output is in {folder / LOG}.")
    made = max(new, key=lambda path: int(path.name.rpartition("_")[2]))  # two where a machine was lost
    try:
        done = read_run(made)
        found = score_of(done, goal, objective, run.n_timesteps)
    except NothingLoggedError as error:
        if not no_episode_ended(made):
            raise RunFailedError(str(error)) from error
        raise RunFailedError(
            f"No training episode ended within the budget of {run.n_timesteps:,} primitive steps. Give a larger "
            "n_timesteps, or the environment a shorter time limit."
        ) from error
    except (ValueError, OSError) as error:
        raise RunFailedError(str(error)) from error
    with atomic_write(folder / SCORE) as temporary:
        content = {"score": found, "at_once": at_once(goal, [done], source_of_score(done))}
        temporary.write_text(json.dumps(content), encoding="utf-8")
    return found


def was_there_at_once(run: TrainConfig) -> bool:
    """Whether a run that was scored had the goal at its first entry."""
    file = run.tensorboard_log / SCORE
    return file.is_file() and bool(json.loads(file.read_text(encoding="utf-8")).get("at_once", False))


def source_of_score(run: Run) -> str:
    """Evaluations, if it made any."""
    return "eval" if run.curves["eval"] else "rollout"


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
    source = source_of_score(run)
    if goal.measure not in run.curves[source]:
        raise ValueError(f"{run.folder} did not log {goal.measure}: choose --reach {', '.join(run.curves[source])}.")
    curve = run.curves[source][goal.measure]
    if objective == "end":
        return at_the_end(curve, n_timesteps)
    at = goal.reached(curve)
    return math.log(max(1.0, n_timesteps if at is None else curve.steps[at]))
