"""How fast options run in 64 environments: `OptionsVecEnv` beside `OptionsWrapper`s in a ``DummyVecEnv``.

``python -m benchmarks.many_environments --out FOLDER`` discovers options in two rooms, then lets both step in turns,
with masks and random choices among what these allow. Environments of the first step together in numpy
(`VecGridWorld`). It writes ``results.json``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.table import Table
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from benchmarks.turns import take_turns
from benchmarks.vec_grid import VecGridWorld
from experiments.common.study import show, write
from sb3_options import OptionsVecEnv, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs import GridWorld
from sb3_options.envs.gridworld.maps import TWO_ROOMS
from sb3_options.options.option import Option
from sb3_options.runs.intervals import mean_interval

GAMMA = 0.97
MAX_STEPS = 200
BAR = 3.0
"""Least ratio of primitive steps per second."""


@dataclass(frozen=True)
class Benchmark:
    """Time options in many environments, in either way.

    Attributes:
        out: Folder for results.json.
        rounds: Turns.
        calls: Of ``step`` in a turn.
        n_envs: Environments.
        seed: Of everything random.
    """

    out: Path
    rounds: int = 20
    calls: int = 300
    n_envs: int = 64
    seed: int = 0


def discovered(seed: int) -> dict[int, Option]:
    """Options of a short training in two rooms, by slot."""
    venv = DummyVecEnv([lambda: OptionsWrapper(GridWorld(TWO_ROOMS, max_steps=400), gamma=GAMMA) for _ in range(8)])
    model = MaskablePPO("MlpPolicy", venv, gamma=GAMMA, n_steps=64, seed=seed, device="cpu")
    callback = SubgoalDiscoveryCallback()
    model.learn(25_000, callback=callback)
    bank = callback.bank
    return {slot: bank[slot].bind(None) for slot in bank.filled}  # type: ignore[union-attr]  # discovered, and there


def rate(venv: VecEnv, calls: int, random: np.random.Generator) -> float:
    """Primitive steps per second of processor time."""
    n_steps = 0
    began = time.process_time()
    for _ in range(calls):
        masks = np.stack(venv.env_method("action_masks"))
        actions = (masks * random.random(masks.shape)).argmax(axis=1)
        *_, infos = venv.step(actions)
        n_steps += sum(info["option"]["duration"] for info in infos)
    return n_steps / (time.process_time() - began)


def main(benchmark: Benchmark) -> None:
    """Run the benchmark, and write and print what it found."""
    torch.set_num_threads(1)
    options = discovered(benchmark.seed)
    n = benchmark.n_envs
    single = DummyVecEnv(
        [lambda: OptionsWrapper(GridWorld(TWO_ROOMS, max_steps=MAX_STEPS), gamma=GAMMA) for _ in range(n)]
    )
    venvs = {
        "OptionsWrapper": single,
        "OptionsVecEnv": OptionsVecEnv(VecGridWorld(TWO_ROOMS, n, max_steps=MAX_STEPS), gamma=GAMMA),
    }
    random = np.random.default_rng(benchmark.seed)
    results: dict[str, Any] = {"command": command(benchmark), "options": len(options)}
    table = Table("", *(f"{name}, steps/s" for name in venvs), "ratio", "95 % interval", "bar")
    for records in (False, True):
        for venv in venvs.values():
            venv.env_method("set_slots", options=options, record=records, expect_empty=True)
            venv.reset()
            rate(venv, benchmark.calls, random)
        rates = take_turns(list(venvs), lambda name: rate(venvs[name], benchmark.calls, random), benchmark.rounds)
        ratio = mean_interval(np.array(rates["OptionsVecEnv"]) / rates["OptionsWrapper"])
        medians = {name: float(np.median(of)) for name, of in rates.items()}
        label = "recording" if records else "stepping"
        results[label] = {"steps_per_second": medians, **ratio._asdict(), "bar": BAR}
        cells = [f"{median:,.0f}" for median in medians.values()]
        table.add_row(label, *cells, f"{ratio.mean:.2f}", f"{ratio.low:.2f} to {ratio.high:.2f}", f"≥ {BAR}")
    write(benchmark.out, results, {}, dpi=110)
    show(table, f"Results: {benchmark.out}")


def command(benchmark: Benchmark) -> str:
    """The command line that measures the same."""
    words = f"--rounds {benchmark.rounds} --calls {benchmark.calls} --n-envs {benchmark.n_envs} --seed {benchmark.seed}"
    return f"python -m benchmarks.many_environments {words} --out FOLDER"


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
