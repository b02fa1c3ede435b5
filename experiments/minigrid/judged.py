"""``python -m experiments.minigrid.judged --out FOLDER``: what judging options by their use changes, task by task.

MaskablePPO with the settings of ``train.py``. Options are discovered in the task, from the first step or after
demonstrations (``--shown``), or they come from 40,000 steps in two rooms (``--carried``). Noted are the share of
training that searches take, how the last 100 runs of each option ended, which options were closed, and the frames to a
success rate of 0.8.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from sb3_contrib import MaskablePPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, write
from experiments.demonstrations.conditions import FIRST_SEED
from experiments.demonstrations.experts import expert_of
from sb3_options import OptionsWrapper, record_demonstrations
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs.minigrid import DISCOVERY, make

TWO_ROOMS, TWO_ROOMS_FRAMES = "MiniGrid-MultiRoom-N2-S4-v0", 40_000
EPISODES = 100
ENOUGH = 0.8


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Does judging options by their use help?

    Attributes:
        tasks: Names of MiniGrid's environments, without ``MiniGrid-`` and ``-v0``, with commas between.
        frames: Primitive steps in each.
        carried: Whether options come from two rooms.
        judge: Whether options are judged.
        asked: Whether φ says where the things are that missions name.
        until_learned: Whether training ends at a success rate of 0.8.
        shown: Demonstrations of MiniGrid's own bot that discovery begins with.
    """

    tasks: str = "PutNear-6x6-N2,LavaGapS6,ObstructedMaze-1Dl"
    frames: int = 60_000
    runs: int = 1
    first_seed: int = 0
    carried: bool = False
    judge: bool = True
    asked: bool = True
    until_learned: bool = False
    shown: int = 0


class Notes(BaseCallback):
    """Notes success, and how runs of options end.

    Args:
        discovery: Whose options.
        stop: Whether training ends at `ENOUGH`.
    """

    def __init__(self, discovery: SubgoalDiscoveryCallback, *, stop: bool) -> None:
        super().__init__()
        self.discovery = discovery
        self.stop = stop
        self.learned: int | None = None
        self.runs: dict[str, deque[str]] = {}
        self.successes: deque[bool] = deque(maxlen=EPISODES)

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "is_success" in info:
                self.successes.append(info["is_success"])
            run = info["option"]
            option = self.discovery.bank[run["index"]] if run.get("inside") else None
            if option is not None:
                self.runs.setdefault(option.name, deque(maxlen=EPISODES)).append(run["termination"])
        if self.learned is None and len(self.successes) == EPISODES and np.mean(self.successes) >= ENOUGH:
            self.learned = self.num_timesteps
        return not (self.stop and self.learned)


def train(study: Study, task: str, frames: int, seed: int, options: Path | None, save: Path | None) -> dict[str, Any]:
    """One training; ``save`` is where its options go."""

    def wrapped(env: Any) -> OptionsWrapper:
        return OptionsWrapper(env, 4, gamma=0.99, options_file=options)

    venv = make_vec_env(lambda: make(task, asked=study.asked), 8, seed=seed, wrapper_class=wrapped)
    how: dict[str, Any] = {"n_steps": 128, "batch_size": 256, "n_epochs": 4, "learning_rate": 1e-3, "ent_coef": 0.01}
    model = MaskablePPO("MlpPolicy", venv, gamma=0.99, seed=seed, device="cpu", **how)
    env = wrapped(make(task, asked=study.asked))
    shown = (
        record_demonstrations(env, expert_of(env), study.shown, seed=FIRST_SEED + 1000 * seed) if study.shown else None
    )
    judging = {} if study.judge else {"min_reached": 0}
    discovery = SubgoalDiscoveryCallback(**DISCOVERY, usefulness=judging, demonstrations=shown, clone=False)
    notes = Notes(discovery, stop=study.until_learned and save is None)
    began = time.process_time()
    model.learn(frames, callback=[discovery, notes])
    seconds = time.process_time() - began
    assert discovery.discovery is not None  # it has trained
    if save is not None:
        discovery.bank.save(save)
    offered = [option.name for option in discovery.bank.slots if option is not None]
    return {
        "frames": model.num_timesteps,
        "frames_to_0.8": notes.learned,
        "success": float(np.mean(notes.successes or [0.0])),
        "search_share": discovery.discovery.diary.seconds / seconds,
        "found": [[found.where, found.timestep] for found in discovery.discoveries],
        "closed": [[closed.slot, closed.timestep, closed.why] for closed in discovery.closed],
        "runs": {
            name: {"offered": name in offered, **{why: n / len(ends) for why, n in Counter(ends).items()}}
            for name, ends in notes.runs.items()
        },
    }


def run(study: Study, task: str, seed: int) -> dict[str, Any]:
    """A training in a task, after one in two rooms where options are carried."""
    options = study.out / f"two-rooms-{seed}.safetensors" if study.carried else None
    if options is not None and not options.exists():
        options.parent.mkdir(parents=True, exist_ok=True)
        train(study, TWO_ROOMS, TWO_ROOMS_FRAMES, seed, None, options)
    return train(study, f"MiniGrid-{task}-v0", study.frames, seed, options, None)


def main(study: Study) -> None:
    """Run the study, and write what it found."""
    tasks = study.tasks.split(",")
    parts = [Part(task, partial(run, study, task), study.out / "runs" / task) for task in tasks]
    varied = {name: getattr(study, name) for name in ("frames", "carried", "judge", "asked", "until_learned", "shown")}
    results = run_parts(parts, study.seeds(), settings=varied, on=study, description="MiniGrid")
    flags = "".join(
        f" --{'' if value else 'no-'}{name.replace('_', '-')}{'' if isinstance(value, bool) else f' {value}'}"
        for name, value in varied.items()
        if value != getattr(Study, name)
    )
    command = f"python -m experiments.minigrid.judged --tasks {study.tasks}{flags} --runs {study.runs} "
    command += f"--first-seed {study.first_seed} --out FOLDER"
    write(study.out, {"command": command, **varied, "results": results}, {})


if __name__ == "__main__":
    main(tyro.cli(Study))
