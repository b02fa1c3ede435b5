"""``python -m experiments.kills --kills 100 --out FOLDER``: does a run that is killed end like one that is not?

For every case ``train.py``, or a script of a user's, runs once undisturbed. Then it runs again and again, is killed by
SIGKILL at random moments, and resumed until it is done. What is left must be equal, byte for byte. A run counts only if
training went on from a checkpoint beyond step 0. Writes ``results.json``; where there is one with the same settings,
its kills count, and only what is missing is done.
"""

from __future__ import annotations

import json
import re
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
from experiments.kills.comparison import differences, of_checkpoints
from sb3_options.runs import folder as runs

ROOT = Path(__file__).parents[2]
SCRIPT = "script"
WORKERS = ("ppo", "--vec-env", "subproc", "--n-envs", "2", "--n-steps", "256")
CASES: dict[str, tuple[str, ...]] = {
    **{name: (name,) for name in ("maskableppo", "ppo", "dqn", "optiondqn", "a2c", "recurrentppo")},
    "ppo in worker processes": WORKERS,
    "ppo with a bonus (RND)": ("ppo", "--bonus", "rnd"),
    "dqn with a learned map": ("dqn", "--feature-map", "temporal-distance"),
    "ppo with relative novelty": ("ppo", "--discovery.method", "relative-novelty"),
    "a script of a user's": (SCRIPT,),
}
"""What runs, by name: arguments of ``train.py``, or `experiments.kills.script`."""

GOES_ON = re.compile(rb"Going on after ([\d,]+) primitive steps")


@dataclass(frozen=True, kw_only=True)
class Study:
    """Kill training at random moments, and resume it until it is done.

    Attributes:
        out: Folder for results.json and the runs.
        kills: How many, all cases together.
        cases: Which of `CASES`, in turn.
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
    cases: tuple[str, ...] = tuple(CASES)
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
        case: Which of `CASES`.
        kills: Seconds after training had begun, or None if it had not, and the newest checkpoint's steps, or None.
        went_on_from: Steps of the checkpoints that training went on from.
        differences: From the run that was left alone, by what was compared.
    """

    case: str
    kills: list[tuple[float | None, int | None]] = field(default_factory=list)
    went_on_from: list[int] = field(default_factory=list)
    differences: dict[str, list[str]] = field(default_factory=dict)

    @property
    def counts(self) -> bool:
        """Whether training went on from a checkpoint beyond step 0."""
        return any(steps > 0 for steps in self.went_on_from)


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    victims = _done(study)
    alone: dict[str, tuple[Path, float]] = {}
    while (done := sum(len(victim.kills) for victim in victims)) < study.kills:
        case = study.cases[len(victims) % len(study.cases)]
        if case not in alone:
            alone[case] = _undisturbed(study, case)
        victim = Victim(case)
        folder = study.out / f"victim_{len(victims)}"
        undisturbed, seconds = alone[case]
        random = np.random.default_rng([study.seed, len(victims)])
        most = min(study.kills - done, study.kills_per_run)
        run = _killed(study, victim, folder, random, most, study.share * seconds)
        compare = of_checkpoints if CASES[case] == (SCRIPT,) else differences
        victim.differences = compare(undisturbed, run)
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


def _command(study: Study, case: str, folder: Path) -> list[str]:
    if CASES[case] == (SCRIPT,):
        return ["-m", "experiments.kills.script", str(folder), str(study.n_timesteps), str(study.checkpoint_freq)]
    settings = ["--n-timesteps", str(study.n_timesteps), "--checkpoint-freq", str(study.checkpoint_freq)]
    log = ["--no-progress", "--tensorboard-log", str(folder)]
    return [str(ROOT / "train.py"), *CASES[case], *settings, *study.flags, *log]


def _start(args: list[str], log: Path) -> subprocess.Popen[bytes]:
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as output:
        return subprocess.Popen([sys.executable, "-u", *args], stdout=output, cwd=ROOT)


def _wait_for_training(process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until a process says that it trains, or ends."""
    while process.poll() is None and b"Training " not in log.read_bytes():
        time.sleep(0.02)


def _undisturbed(study: Study, case: str) -> tuple[Path, float]:
    """The run folder of one that is left alone, and the seconds that it trained."""
    name = f"alone_{study.cases.index(case)}"
    folder, log = (study.out / name).resolve(), study.out / f"{name}.log"
    shutil.rmtree(folder, ignore_errors=True)
    process = _start(_command(study, case, folder), log)
    _wait_for_training(process, log)
    began = time.monotonic()
    if process.wait() != 0:
        raise RuntimeError(f"{case} failed, see {log}")
    return _run_in(folder), time.monotonic() - began


def _run_in(folder: Path) -> Path:
    """The folder that contains the checkpoints."""
    return next(folder.rglob(runs.CHECKPOINTS)).parent


def _steps(folder: Path) -> int | None:
    """Of the newest checkpoint of a run."""
    files = [file.stem for file in folder.rglob("*.safetensors") if file.stem.isdecimal()]
    return max(map(int, files), default=None)


def _killed(study: Study, victim: Victim, folder: Path, random: np.random.Generator, most: int, longest: float) -> Path:
    """Train, with up to ``most`` kills; returns the run folder."""
    folder = folder.resolve()
    args, log = _command(study, victim.case, folder), folder.with_suffix(".log")
    shutil.rmtree(folder, ignore_errors=True)
    while True:
        process = _start(args, log)
        is_early = random.random() < study.early
        moment = float(random.uniform(0, longest))
        if not is_early:
            _wait_for_training(process, log)
            while process.poll() is None and not _steps(folder):  # there is nothing to go on from before
                time.sleep(0.02)
        try:
            code = process.wait(moment if len(victim.kills) < most else None)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            code = process.wait()
        victim.went_on_from += [int(steps.replace(b",", b"")) for steps in GOES_ON.findall(log.read_bytes())]
        if code == 0:
            return _run_in(folder)
        if code != -signal.SIGKILL:
            raise RuntimeError(f"{' '.join(args)} ended with exit status {code}, see {log}")
        victim.kills.append((None if is_early else moment, _steps(folder)))
        if _steps(folder) is None:  # it was killed before there was anything
            shutil.rmtree(folder, ignore_errors=True)
        elif CASES[victim.case] != (SCRIPT,):
            args = [str(ROOT / "train.py"), "resume", str(_run_in(folder)), "--no-progress"]


def _report(study: Study, victims: list[Victim]) -> None:
    content = {
        "study": _settings(study),
        "kills": sum(len(victim.kills) for victim in victims),
        "runs": len(victims),
        "runs_that_count": sum(victim.counts for victim in victims),
        "runs_that_differ": sum(any(victim.differences.values()) for victim in victims),
        "victims": [asdict(victim) for victim in victims],
    }
    write(study.out, content, {})


def _table(victims: list[Victim]) -> Table:
    columns = ("case", "runs that count", "kills", "while it trained", "went on from", "runs that differ")
    table = Table(*columns)
    for case in dict.fromkeys(victim.case for victim in victims):
        those = [victim for victim in victims if victim.case == case]
        moments = [kill for victim in those for kill in victim.kills]
        training = sum(seconds is not None for seconds, _ in moments)
        steps = ", ".join(f"{steps:,}" for victim in those for steps in victim.went_on_from)
        count = f"{sum(victim.counts for victim in those)} of {len(those)}"
        differ = sum(any(victim.differences.values()) for victim in those)
        table.add_row(case, count, *map(str, (len(moments), training, steps, differ)))
    return table


if __name__ == "__main__":
    main(tyro.cli(Study))
