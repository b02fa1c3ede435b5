"""``python -m experiments.kills --kills 100 --out FOLDER``: does a run that is killed end like one that is not?

For every algorithm ``train.py`` runs once undisturbed. Then it runs again and again, is killed by SIGKILL at random
moments, and resumed until it is done. What is left must be equal, byte for byte. Writes ``results.json``; where there
is one with the same settings, its kills count, and only what is missing is done.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.table import Table

from experiments.common.study import RESULTS, show, write
from experiments.kills.comparison import differences
from sb3_options.runs import folder as runs

ROOT = Path(__file__).parents[2]
ALGORITHMS = ("maskableppo", "ppo", "dqn", "optiondqn")


@dataclass(frozen=True, kw_only=True)
class Study:
    """Kill training at random moments, and resume it until it is done.

    Attributes:
        out: Folder for results.json and the runs.
        kills: How many, all algorithms together.
        algorithms: Which, in turn.
        n_timesteps: Primitive steps of a run.
        checkpoint_freq: Primitive steps between checkpoints.
        kills_per_run: Most kills of one run.
        early: Share of the kills that come while a process starts; the others come while it trains.
        share: A process that trains is killed within this share of the time that the undisturbed training took.
        seed: Of the moments, with the number of the run that is killed.
        flags: More flags of train.py, as one text each.
    """

    out: Path
    kills: int = 100
    algorithms: tuple[str, ...] = ALGORITHMS
    n_timesteps: int = 8_000
    checkpoint_freq: int = 1_000
    kills_per_run: int = 8
    early: float = 0.1
    share: float = 0.4
    seed: int = 0
    flags: tuple[str, ...] = ("--eval-freq", "5000", "--eval-episodes", "2")


@dataclass
class Victim:
    """One run that was killed and resumed until it was done.

    Attributes:
        algorithm: Which.
        kills: Seconds after training had begun, or None if it had not, and the newest checkpoint's steps, or None.
        differences: From the run that was left alone, by what was compared.
    """

    algorithm: str
    kills: list[tuple[float | None, int | None]] = field(default_factory=list)
    differences: dict[str, list[str]] = field(default_factory=dict)


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    victims = _done(study)
    alone: dict[str, tuple[Path, float]] = {}
    while (done := sum(len(victim.kills) for victim in victims)) < study.kills:
        algorithm = study.algorithms[len(victims) % len(study.algorithms)]
        if algorithm not in alone:
            alone[algorithm] = _undisturbed(study, algorithm)
        victim = Victim(algorithm)
        folder = study.out / f"victim_{len(victims)}"
        undisturbed, seconds = alone[algorithm]
        random = np.random.default_rng([study.seed, len(victims)])
        most = min(study.kills - done, study.kills_per_run)
        run = _killed(study, victim, folder, random, most, study.share * seconds)
        victim.differences = differences(undisturbed, run)
        victims.append(victim)
        shutil.rmtree(folder)
        _report(study, victims)
    show(_table(victims), f"Results: {study.out / 'results.json'}")


def _done(study: Study) -> list[Victim]:
    """The victims of a results.json with the same settings; none where there is no such file."""
    path = study.out / RESULTS
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {"study": {}}
    same = {name: found["study"].get(name) == value for name, value in _settings(study).items() if name != "kills"}
    return [Victim(**victim) for victim in found["victims"]] if all(same.values()) else []


def _settings(study: Study) -> dict[str, Any]:
    """Everything but the folder, as JSON has it."""
    settings: dict[str, Any] = json.loads(json.dumps(asdict(study), default=str))
    settings.pop("out")
    return settings


def _command(study: Study, algorithm: str, folder: Path) -> list[str]:
    settings = ["--n-timesteps", str(study.n_timesteps), "--checkpoint-freq", str(study.checkpoint_freq)]
    return [algorithm, *settings, *study.flags, "--no-progress", "--tensorboard-log", str(folder)]


def _start(args: list[str], log: Path) -> subprocess.Popen[bytes]:
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as output:
        return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *args], stdout=output)


def _wait_for_training(process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until a process says that it trains, or ends."""
    while process.poll() is None and b"Training " not in log.read_bytes():
        time.sleep(0.02)


def _undisturbed(study: Study, algorithm: str) -> tuple[Path, float]:
    """The run folder of one that is left alone, and the seconds that it trained."""
    folder, log = study.out / f"alone_{algorithm}", study.out / f"alone_{algorithm}.log"
    shutil.rmtree(folder, ignore_errors=True)
    process = _start(_command(study, algorithm, folder), log)
    _wait_for_training(process, log)
    began = time.monotonic()
    if process.wait() != 0:
        raise RuntimeError(f"train.py {algorithm} failed, see {log}")
    return _run_in(folder, algorithm), time.monotonic() - began


def _run_in(folder: Path, algorithm: str) -> Path:
    return next((folder / algorithm).iterdir())


def _killed(study: Study, victim: Victim, folder: Path, random: np.random.Generator, most: int, longest: float) -> Path:
    """Train, with up to ``most`` kills; returns the run folder."""
    args, log = _command(study, victim.algorithm, folder), folder.with_suffix(".log")
    shutil.rmtree(folder, ignore_errors=True)
    while True:
        process = _start(args, log)
        is_early = random.random() < study.early
        moment = float(random.uniform(0, longest))
        if not is_early:
            _wait_for_training(process, log)
        try:
            code = process.wait(moment if len(victim.kills) < most else None)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            code = process.wait()
        if code == 0:
            return _run_in(folder, victim.algorithm)
        if code != -signal.SIGKILL:
            raise RuntimeError(f"train.py {' '.join(args)} ended with exit status {code}, see {log}")
        there = sorted((folder / victim.algorithm).glob(f"*/{runs.CHECKPOINTS}/0*"))
        victim.kills.append((None if is_early else moment, int(there[-1].stem) if there else None))
        if there:
            args = ["resume", str(there[0].parents[1]), "--no-progress"]
        else:  # it was killed before there was anything
            shutil.rmtree(folder, ignore_errors=True)


def _report(study: Study, victims: list[Victim]) -> None:
    content = {
        "study": _settings(study),
        "kills": sum(len(victim.kills) for victim in victims),
        "runs": len(victims),
        "runs_that_differ": sum(any(victim.differences.values()) for victim in victims),
        "victims": [asdict(victim) for victim in victims],
    }
    write(study.out, content, {})


def _table(victims: list[Victim]) -> Table:
    table = Table("algorithm", "runs", "kills", "while it trained", "before the first checkpoint", "runs that differ")
    for algorithm in dict.fromkeys(victim.algorithm for victim in victims):
        those = [victim for victim in victims if victim.algorithm == algorithm]
        moments = [kill for victim in those for kill in victim.kills]
        training = sum(seconds is not None for seconds, _ in moments)
        early = sum(steps is None for _, steps in moments)
        differ = sum(any(victim.differences.values()) for victim in those)
        table.add_row(algorithm, *map(str, (len(those), len(moments), training, early, differ)))
    return table


if __name__ == "__main__":
    main(tyro.cli(Study))
