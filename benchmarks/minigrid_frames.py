"""What a frame with options costs in MiniGrid, beside one of stock PPO.

``python -m benchmarks.minigrid_frames --out FOLDER`` trains both through the stages of a family of
``experiments.minigrid`` before the last. There options are discovered. Then both train on in the last stage and take
turns, a rollout with its updates each; ratios are those of a turn. It writes ``results.json``.
"""

from __future__ import annotations

import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Semaphore
from typing import Any

import numpy as np
import torch
import tyro
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from experiments.common.study import show, write
from experiments.minigrid import settings
from experiments.minigrid.agents import Notes, model_of, venv_of
from experiments.minigrid.conditions import callbacks_of
from experiments.minigrid.settings import FAMILIES, Arm
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.runs.intervals import mean_interval

BAR = 1.2
"""Largest ratio of processor time per frame."""

ARMS: tuple[Arm, Arm] = ("discovered, RND before the last", "stock, RND before the last")
LEARNED = 0.9
"""Share of successes at which a stage before the last ends."""


@dataclass(frozen=True)
class Benchmark:
    """Time frames with options and without, in turns.

    Attributes:
        out: Folder for results.json.
        families: Keys of ``experiments.minigrid.settings.FAMILIES``, with commas between.
        frames: Primitive steps of each agent in the last stage.
        seed: Of everything random.
    """

    out: Path
    families: str = "MultiRoom-4,KeyCorridor"
    frames: int = 200_000
    seed: int = 0


class Turns(BaseCallback):
    """Lets two trainings take turns, a rollout with its updates each.

    Args:
        mine: Is released when it is this one's turn.
        other: Is released when it is the other training's turn.

    Attributes:
        marks: Primitive steps and seconds of processor time when each turn began.
    """

    def __init__(self, mine: Semaphore, other: Semaphore) -> None:
        super().__init__()
        self.mine, self.other = mine, other
        self.marks: list[tuple[int, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.marks:  # the first rollout has no turn before it
            self.other.release()
        self.mine.acquire()
        self.marks.append((self.model.num_timesteps, time.thread_time()))

    def costs(self) -> list[float]:
        """Microseconds per frame in each turn but the first, in which kernels compile and caches fill."""
        turns = zip(self.marks, self.marks[1:], strict=False)
        return [(later - sooner) / (after - before) * 1e6 for (before, sooner), (after, later) in turns][1:]


def trained(family: str, arm: Arm, seed: int) -> tuple[BaseAlgorithm, list[BaseCallback], int]:
    """A model in the last stage after training in the others, its callbacks, and how many options it has."""
    slots = settings.max_options(family) if arm in settings.WITH_OPTIONS else 0
    last = FAMILIES[family][-1]
    model: Any = None
    options = None
    n_options = 0
    with tempfile.TemporaryDirectory() as folder:
        for number, stage in enumerate(FAMILIES[family]):
            venv = venv_of(stage.env_id, seed, slots=slots, options=options)
            if model is None:
                model = model_of(arm, venv, seed)
            else:
                model.set_env(venv)
            rollouts = settings.primitive_rollouts(stage)
            callbacks = callbacks_of(arm, seed, number, None, is_last=stage is last, primitive_rollouts=rollouts)
            if stage is last:
                break
            model.learn(stage.frames, callback=[*callbacks, Notes(settings.N_ENVS, LEARNED)])
            for each in callbacks:
                if isinstance(each, SubgoalDiscoveryCallback):
                    options, n_options = Path(folder) / "options", len(each.bank)
                    each.bank.save(options)
            venv.close()
    return model, callbacks, n_options


def race(family: str, frames: int, seed: int) -> dict[str, Any]:
    """Costs of a frame in every turn, and their ratio."""
    contestants = {arm: trained(family, arm, seed) for arm in ARMS}
    semaphores = Semaphore(1), Semaphore(0)
    turns = {arm: Turns(*of) for arm, of in zip(ARMS, (semaphores, semaphores[::-1]), strict=True)}

    def train(arm: Arm) -> None:
        model, callbacks, _ = contestants[arm]
        try:
            model.learn(frames, callback=[*callbacks, turns[arm]])
        finally:  # the other one need not wait any more
            turns[arm].other.release(frames)

    with ThreadPoolExecutor(len(ARMS)) as threads:
        for done in [threads.submit(train, arm) for arm in ARMS]:
            done.result()
    costs = [turns[arm].costs() for arm in ARMS]
    ratio = mean_interval(np.array([one / other for one, other in zip(*costs, strict=False)]))
    medians = {arm: float(np.median(of)) for arm, of in zip(ARMS, costs, strict=True)}
    first = ARMS[0]
    return {
        "microseconds": medians,
        "options": contestants[first][2],
        "frames_per_decision": contestants[first][0].num_timesteps / (turns[first].n_calls * settings.N_ENVS),
        "n_turns": min(map(len, costs)),
        **ratio._asdict(),
        "bar": BAR,
    }


def main(benchmark: Benchmark) -> None:
    """Run the benchmark, and write and print what it found."""
    torch.set_num_threads(1)
    families = benchmark.families.split(",")
    command = f"python -m benchmarks.minigrid_frames --families {benchmark.families} --frames {benchmark.frames}"
    command += f" --seed {benchmark.seed} --out FOLDER"
    results = {family: race(family, benchmark.frames, benchmark.seed) for family in families}
    write(benchmark.out, {"command": command, **results}, {}, dpi=110)
    table = Table("", "options", "frames a decision", "µs a frame", "PPO, µs a frame", "ratio", "95 % interval", "bar")
    for family, of in results.items():
        cells = (f"{cost:.0f}" for cost in of["microseconds"].values())
        interval = f"{of['low']:.2f} to {of['high']:.2f}"
        decision = f"{of['frames_per_decision']:.2f}"
        table.add_row(family, str(of["options"]), decision, *cells, f"{of['mean']:.2f}", interval, f"≤ {BAR}")
    show(table, f"Results: {benchmark.out}")


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
