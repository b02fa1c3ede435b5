"""What options cost: primitive steps per second of stock DQN and PPO, wrapped, and discovering.

``python -m benchmarks.overhead --out FOLDER`` lets the contestants of a scenario (DQN; PPO; PPO with eight worker
processes) take turns, a chunk of training each, so that a machine that slows down slows all of them; ratios are taken
within each turn. It writes ``results.json`` and ``overhead.png``. ``--scenarios
ppo_checkpoints,dqn_checkpoints,large_buffer`` measures the default checkpoints of ``train.py``, in processor time, and
``--scenarios phases`` where the time of a step goes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from rich.table import Table
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import sb3_options.envs  # noqa: F401  # registers them
from benchmarks import checkpoints, phases
from benchmarks.turns import take_turns
from experiments.common.study import show, write
from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.runs.intervals import mean_interval

ENV = "sb3_options.envs:sb3_options/TwoRooms-v0"  # with its module, for worker processes
GAMMA = 0.97
SLOTS = 4
BARS = {"wrapped": 0.95, "discovering": 0.90}
Kind = Literal["stock", "wrapped", "discovering"]
KINDS: dict[str, tuple[Kind, ...]] = {
    "dqn": ("stock", "wrapped", "discovering"),
    "ppo": ("stock", "wrapped", "discovering"),
    "ppo_subprocesses": ("stock", "wrapped"),
}
"""Contestants by scenario. With worker processes the machine's scheduler is in the race too, so that only what is
free of options is compared."""

N_SUBPROCESSES = 8


@dataclass(frozen=True)
class Benchmark:
    """Time stock, wrapped and discovering training in turns.

    Attributes:
        out: Folder for results.json and overhead.png.
        rounds: Turns.
        chunk: Primitive steps of training a turn.
        seed: Of everything random.
        scenarios: Which, with commas between: dqn, ppo, ppo_subprocesses; ppo_checkpoints, dqn_checkpoints,
            large_buffer, whose turns are as long as a checkpoint is good for; phases, ten chunks of each training.
    """

    out: Path
    rounds: int = 30
    chunk: int = 2048
    seed: int = 0
    scenarios: str = ",".join(KINDS)


def make(scenario: str, kind: Kind, seed: int) -> tuple[BaseAlgorithm, BaseCallback | None]:
    """The model of one contestant; all of a scenario have the same hyper-parameters."""
    n_envs = N_SUBPROCESSES if scenario == "ppo_subprocesses" else 1
    venv = make_vec_env(
        ENV,
        n_envs,
        seed=seed,
        vec_env_cls=SubprocVecEnv if n_envs > 1 else DummyVecEnv,
        wrapper_class=None if kind == "stock" else OptionsWrapper,
        wrapper_kwargs=None if kind == "stock" else {"max_options": SLOTS, "gamma": GAMMA},
    )
    model = _dqn(venv, kind, seed) if scenario == "dqn" else _ppo(venv, seed)
    callback: BaseCallback | None = None
    if kind == "discovering":
        callback = SubgoalDiscoveryCallback()
    elif kind == "wrapped" and scenario != "dqn":
        callback = PrimitiveStepsCallback()  # on-policy algorithms learn from it how long the actions took
    return model, callback


def _dqn(venv: VecEnv, kind: Kind, seed: int) -> DQN:
    return DQN(
        "MlpPolicy",
        venv,
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


def _ppo(venv: VecEnv, seed: int) -> PPO:
    return PPO("MlpPolicy", venv, seed=seed, gamma=GAMMA, n_steps=512 // venv.num_envs, batch_size=64, device="cpu")


def timed_chunk(model: BaseAlgorithm, callback: BaseCallback | None, chunk: int, clock: Callable[[], float]) -> float:
    """Train on, and return primitive steps per second."""
    before, began = model.num_timesteps, clock()
    model.learn(chunk, callback=callback, reset_num_timesteps=False)
    return (model.num_timesteps - before) / (clock() - began)


def clock_of(scenario: str) -> Callable[[], float]:
    """Processor time, so that other work on the machine does not count; wall time where worker processes work too."""
    return time.perf_counter if scenario == "ppo_subprocesses" else time.process_time


def main(benchmark: Benchmark) -> None:
    """Run the benchmark, and write and print what it found."""
    chosen = [scenario.strip() for scenario in benchmark.scenarios.split(",")]
    known = (*KINDS, *checkpoints.SCENARIOS, "phases")
    unknown = set(chosen) - set(known)
    if unknown:
        raise SystemExit(f"--scenarios: there is no {unknown.pop()!r}, choose from {', '.join(known)}.")
    torch.set_num_threads(1)
    command = f"python -m benchmarks.overhead --rounds {benchmark.rounds} --chunk {benchmark.chunk}"
    command += f" --seed {benchmark.seed} --scenarios {','.join(chosen)}"
    rates = {scenario: race(scenario, benchmark) for scenario in chosen if scenario in KINDS}
    results = {scenario: summarise(of) for scenario, of in rates.items()}
    costs = {
        scenario: checkpoints.measure(scenario, benchmark.rounds, benchmark.seed)
        for scenario in chosen
        if scenario in checkpoints.SCENARIOS
    }
    spent = phases.measure(10 * benchmark.chunk, benchmark.seed) if "phases" in chosen else {}
    write(
        benchmark.out,
        {"command": command, **results, **costs, **({"phases": spent} if spent else {})},
        {"overhead": draw(rates)} if rates else {},
        dpi=110,
    )
    tables = ([_table(results)] if results else []) + ([checkpoints.table(costs)] if costs else [])
    tables += [phases.table(spent)] if spent else []
    show(*tables, f"Results: {benchmark.out}")


def race(scenario: str, benchmark: Benchmark) -> dict[str, list[float]]:
    """Rates of every contestant in every turn, primitive steps per second."""
    contestants = {kind: make(scenario, kind, benchmark.seed) for kind in KINDS[scenario]}
    clock = clock_of(scenario)
    for model, callback in contestants.values():
        timed_chunk(model, callback, benchmark.chunk, clock)  # compiled kernels, filled caches
    rates = take_turns(
        KINDS[scenario],
        lambda kind: timed_chunk(*contestants[cast("Kind", kind)], benchmark.chunk, clock),
        benchmark.rounds,
        description=scenario,
    )
    for model, _ in contestants.values():
        cast("VecEnv", model.get_env()).close()
    return rates


def summarise(rates: dict[str, list[float]]) -> dict[str, Any]:
    """Median rates, and the mean ratio to stock within a turn with its 95 % interval."""
    stock = np.array(rates["stock"])
    results: dict[str, Any] = {
        "n_turns": len(stock),
        "primitive_steps_per_second": {kind: float(np.median(r)) for kind, r in rates.items()},
    }
    for kind in rates.keys() & BARS.keys():
        bar = BARS[kind]
        ratio = mean_interval(np.array(rates[kind]) / stock)
        results[f"{kind}_of_stock"] = {**ratio._asdict(), "bar": bar, "reached": ratio.mean >= bar}
    return results


def draw(rates: dict[str, dict[str, list[float]]]) -> Figure:
    """Rates turn by turn, one panel a scenario."""
    figure = Figure(figsize=(4.2 * len(rates), 3.4), layout="constrained")
    for axes, (scenario, of) in zip(figure.subplots(1, len(rates), squeeze=False)[0], rates.items(), strict=True):
        for kind, values in of.items():
            axes.plot(range(1, len(values) + 1), values, marker=".", label=kind)
        axes.set_title(scenario.replace("_", ", "))
        axes.set_xlabel("turn")
        axes.set_ylim(bottom=0)
    figure.axes[0].set_ylabel("primitive steps per second")
    figure.axes[0].legend(loc="lower left")
    return figure


def _table(results: dict[str, dict[str, Any]]) -> Table:
    table = Table("", "primitive steps/s (median)", "of stock", "95 % interval", "bar")
    for scenario, of in results.items():
        for kind, rate in of["primitive_steps_per_second"].items():
            ratio = of.get(f"{kind}_of_stock")
            cells = ("", "", "")
            if ratio is not None:
                cells = (f"{ratio['mean']:.3f}", f"{ratio['low']:.3f} to {ratio['high']:.3f}", f"≥ {ratio['bar']}")
            table.add_row(f"{scenario} {kind}", f"{rate:,.0f}", *cells)
    return table


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
