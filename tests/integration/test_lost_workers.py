"""``train.py`` whose worker processes are killed: one line, and `resume` ends as if nothing had been."""

import os
import shlex
import signal
from pathlib import Path
from typing import Any

import pytest

from experiments.kills.comparison import differences
from sb3_options import cli
from sb3_options.callbacks.checkpoints import CheckpointCallback
from sb3_options.execution.workers import WorkerLostError
from sb3_options.runs import folder as runs
from sb3_options.runs import training
from tests.support.runs import Refused

FLAGS = (
    "ppo --n-envs 2 --vec-env subproc --n-timesteps 1024 --n-steps 64 --batch-size 64 --n-epochs 1 --net-arch 8 "
    "--eval-freq 0 --checkpoint-freq 256 --env-kwargs max_steps:50 --no-progress --device cpu"
)


class KillsOnce(CheckpointCallback):
    """Kills a worker before a step, the first time that training comes there."""

    at_steps = 700
    killed: list[int] = []  # noqa: RUF012  # of all that are made

    def _on_step(self) -> bool:
        if self.model.num_timesteps >= self.at_steps and not self.killed:
            process = self.training_env.unwrapped.processes[1]  # type: ignore[attr-defined]  # of SubprocVecEnv
            self.killed.append(process.pid)
            os.kill(process.pid, signal.SIGKILL)
        return super()._on_step()


def run_in(folder: Path) -> Path:
    (run,) = folder.glob("ppo/*")
    return run


def test_resumed_after_a_worker_was_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    alone, victim = tmp_path / "alone", tmp_path / "the victim"
    monkeypatch.setattr(training, "CheckpointCallback", KillsOnce)
    monkeypatch.setattr(KillsOnce, "killed", [0])  # that was that
    cli.main([*FLAGS.split(), "--tensorboard-log", str(alone)])
    monkeypatch.setattr(KillsOnce, "killed", [])
    said = refused(*FLAGS.split(), "--tensorboard-log", str(victim), codes=[cli.TRY_AGAIN])
    assert f"Environment 1 of 2 is gone: its worker process (pid {KillsOnce.killed[0]}) was killed by SIGKILL" in said
    assert f"What was learned until then is kept in {run_in(victim)}" in said
    assert (run_in(victim) / runs.MODEL).is_file()
    command = said.partition("Resume: ")[2]
    *_, resume, run = shlex.split(command)
    assert (resume, Path(run).resolve()) == ("resume", run_in(victim).resolve())
    cli.main(["resume", run, "--no-progress"])
    assert {what: those for what, those in differences(run_in(alone), run_in(victim)).items() if those} == {}


def test_a_worker_that_an_error_ended_is_nothing_to_try_again(
    monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    def lost(*_: Any, **__: Any) -> None:
        raise WorkerLostError("Environment 0 of 2 is gone.", "Make new ones.")

    monkeypatch.setattr(training, "train", lost)
    assert refused(*FLAGS.split()) == "Error: Environment 0 of 2 is gone.\n"
