"""What options cost: primitive steps per second of stock DQN, wrapped, and discovering.

``python -m benchmarks.overhead --out FOLDER`` lets the three take turns in one process, a chunk of training each, so
that a machine that slows down slows all of them; ratios are taken within each turn. It writes ``results.json`` and
``overhead.png``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table
from stable_baselines3 import DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

import sb3_options.envs  # noqa: F401  # registers them
from experiments.seeds import write_json
from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.evaluation import mean_interval

ENV = "sb3_options/TwoRooms-v0"
GAMMA = 0.97
SLOTS = 4
BARS = {"wrapped": 0.95, "discovering": 0.90}


@dataclass(frozen=True)
class Benchmark:
    """Time stock DQN, DQN on the wrapped environment, and DQN that discovers options, in turns.

    Attributes:
        out: Folder for results.json and overhead.png.
        rounds: Turns.
        chunk: Primitive steps of training a turn.
        seed: Of everything random.
    """

    out: Path
    rounds: int = 30
    chunk: int = 2000
    seed: int = 0


def make(kind: str, seed: int) -> tuple[DQN, BaseCallback | None]:
    """The model of one contestant, all with the same hyper-parameters."""
    env: gym.Env[Any, Any] = Monitor(gym.make(ENV))
    if kind != "stock":
        env = OptionsWrapper(env, SLOTS, gamma=GAMMA)
    model = DQN(
        "MlpPolicy",
        env,
        seed=seed,
        gamma=GAMMA,
        learning_rate=5e-4,
        buffer_size=50_000,
        learning_starts=500,
        batch_size=64,
        target_update_interval=500,
        exploration_fraction=1.0,
        exploration_final_eps=0.2,
        replay_buffer_class=ReplayBuffer if kind == "stock" else OptionReplayBuffer,
    )
    callback = SubgoalDiscoveryCallback(seed=seed) if kind == "discovering" else None
    return model, callback


def timed_chunk(model: DQN, callback: BaseCallback | None, chunk: int) -> float:
    """Train on, and return primitive steps per second of processor time.

    Everything runs in this one process with one thread, so that its processor time is what it takes undisturbed;
    other work on the machine does not count, as it would in wall time.
    """
    before, began = model.num_timesteps, time.process_time()
    model.learn(chunk, callback=callback, reset_num_timesteps=False)
    return (model.num_timesteps - before) / (time.process_time() - began)


def main(benchmark: Benchmark) -> None:
    """Run the benchmark, and write and print what it found."""
    torch.set_num_threads(1)
    contestants = {kind: make(kind, benchmark.seed) for kind in ("stock", "wrapped", "discovering")}
    for model, callback in contestants.values():
        timed_chunk(model, callback, benchmark.chunk)  # compiled kernels, filled caches
    rates: dict[str, list[float]] = {kind: [] for kind in contestants}
    order = list(contestants)
    for turn in track(range(benchmark.rounds), description="Turns"):
        for kind in order[turn % 3 :] + order[: turn % 3]:
            model, callback = contestants[kind]
            rates[kind].append(timed_chunk(model, callback, benchmark.chunk))
    results = summarise(rates)
    callback = contestants["discovering"][1]
    if isinstance(callback, SubgoalDiscoveryCallback) and callback.discovery is not None:
        results["options_discovered"] = len(callback.discoveries)
        results["seconds_in_discovery"] = callback.discovery.seconds
    command = f"python -m benchmarks.overhead --rounds {benchmark.rounds} --chunk {benchmark.chunk}"
    write_json(benchmark.out / "results.json", {"command": command, **results})
    draw(rates).savefig(benchmark.out / "overhead.png", dpi=110)
    _print(results, benchmark.out)


def summarise(rates: dict[str, list[float]]) -> dict[str, Any]:
    """Median rates, and the mean ratio to stock within a turn with its 95 % interval."""
    stock = np.array(rates["stock"])
    results: dict[str, Any] = {
        "n_turns": len(stock),
        "primitive_steps_per_second": {kind: float(np.median(r)) for kind, r in rates.items()},
    }
    for kind, bar in BARS.items():
        ratio = mean_interval(np.array(rates[kind]) / stock)
        results[f"{kind}_of_stock"] = {**ratio._asdict(), "bar": bar, "reached": ratio.mean >= bar}
    return results


def draw(rates: dict[str, list[float]]) -> Figure:
    """Rates turn by turn."""
    figure = Figure(figsize=(7, 3.5), layout="constrained")
    axes = figure.add_subplot()
    for kind, values in rates.items():
        axes.plot(range(1, len(values) + 1), values, marker=".", label=kind)
    axes.set_xlabel("turn")
    axes.set_ylabel("primitive steps per second of processor time")
    axes.set_ylim(bottom=0)
    axes.legend()
    return figure


def _print(results: dict[str, Any], out: Path) -> None:
    table = Table("", "primitive steps/CPU s (median)", "of stock", "95 % interval", "bar")
    for kind, rate in results["primitive_steps_per_second"].items():
        ratio = results.get(f"{kind}_of_stock")
        cells = ("", "", "")
        if ratio is not None:
            cells = (f"{ratio['mean']:.3f}", f"{ratio['low']:.3f} to {ratio['high']:.3f}", f"≥ {ratio['bar']}")
        table.add_row(kind, f"{rate:,.0f}", *cells)
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    console.print(f"Results: {out / 'results.json'}, {out / 'overhead.png'}")


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
