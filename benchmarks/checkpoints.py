"""What the default checkpoints of ``train.py`` cost, in processor time: scenarios of `benchmarks.overhead`."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from gymnasium.spaces import Discrete
from rich.table import Table
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.turns import take_turns
from experiments.common.intervals import ratio_interval
from sb3_options.callbacks import CheckpointCallback, SubgoalDiscoveryCallback
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.config import TrainConfig, configure
from sb3_options.runs.intervals import mean_interval

BAR = 0.02
"""Largest share of the processor time of training that checkpoints may take."""

CONFIGS = {"ppo_checkpoints": "ppo", "dqn_checkpoints": "dqn"}
"""Algorithms by scenario, with the settings of train.py."""

LARGE = "large_buffer"
"""The scenario of one checkpoint with a large replay buffer."""

SCENARIOS = (*CONFIGS, LARGE)
LARGE_BUFFER = 1_000_000
"""Its transitions."""

LATER = 2
"""Checkpoints of it that are timed, after the first, which writes all of it."""

EXTRA = 100
"""Primitive steps beyond those between two checkpoints."""


class TimedCheckpoints(CheckpointCallback):
    """Adds up the processor time that checkpoints take."""

    seconds = 0.0
    written = 0

    def _on_rollout_start(self) -> None:
        began, last = time.process_time(), self._last
        super()._on_rollout_start()
        self.seconds += time.process_time() - began
        self.written += self._last != last


class Turn(NamedTuple):
    """What a contestant did in a turn.

    Attributes:
        rate: Primitive steps per second of processor time.
        seconds: Processor time.
        in_checkpoints: What of it was spent on checkpoints.
        written: Checkpoints.
    """

    rate: float
    seconds: float
    in_checkpoints: float
    written: int


class Contestant:
    """A training as ``train.py`` begins it, with its default checkpoints or without.

    Args:
        config: Of the training.
        folder: Of the checkpoints; None for none.
    """

    def __init__(self, config: TrainConfig, folder: Path | None) -> None:
        env = runs.make_env(config, config.n_envs, config.seed)
        self.n_actions = int(cast("Discrete", env.action_space).n)
        self.model: BaseAlgorithm = make_model(config, env)
        self.callbacks: list[BaseCallback] = [SubgoalDiscoveryCallback(config.discovery, config.option)]
        self.checkpoints = None if folder is None else TimedCheckpoints(folder, config.checkpoint_freq)
        if self.checkpoints is not None:
            self.callbacks.append(self.checkpoints)

    def play(self, chunk: int) -> Turn:
        """Train for ``chunk`` primitive steps more."""
        timed = self.checkpoints
        before = self.model.num_timesteps
        spent, written = (timed.seconds, timed.written) if timed else (0.0, 0)
        began = time.process_time()
        self.model.learn(chunk, self.callbacks, reset_num_timesteps=False)
        seconds = time.process_time() - began
        return Turn(
            (self.model.num_timesteps - before) / seconds,
            seconds,
            timed.seconds - spent if timed else 0.0,
            timed.written - written if timed else 0,
        )

    def close(self) -> None:
        """Close its environments."""
        cast("VecEnv", self.model.get_env()).close()


def measure(scenario: str, rounds: int, seed: int) -> dict[str, Any]:
    """The cost of checkpoints in one of `SCENARIOS`.

    Args:
        scenario: Which.
        rounds: Turns; in each both contestants train until one checkpoint is due.
        seed: Of everything random.
    """
    with tempfile.TemporaryDirectory() as folder:
        if scenario == LARGE:
            return large_buffer(Path(folder), seed, LARGE_BUFFER)
        config = configure(algo=CONFIGS[scenario], seed=seed, device="cpu")
        return race(config, Path(folder), rounds, config.checkpoint_freq, description=scenario)


def race(config: TrainConfig, folder: Path, rounds: int, chunk: int, *, description: str) -> dict[str, Any]:
    """Train with checkpoints and without, in turns of ``chunk`` primitive steps."""
    contestants = {
        "none": Contestant(config, None),
        "checkpoints": Contestant(config, folder),
    }
    for contestant in contestants.values():
        contestant.play(chunk)  # compiled kernels, filled caches, and the first checkpoint, before the first step
    turns = take_turns(list(contestants), lambda name: contestants[name].play(chunk), rounds, description=description)
    for contestant in contestants.values():
        contestant.close()
    return summarise(turns)


def summarise(turns: dict[str, list[Turn]]) -> dict[str, Any]:
    """Median rates, the share of the time that checkpoints took, and the ratio of the rates within a turn."""
    with_, without = (np.array(turns[name]) for name in ("checkpoints", "none"))
    share = ratio_interval(with_[:, 2], with_[:, 1])
    return {
        "n_turns": len(with_),
        "checkpoints_written": int(with_[:, 3].sum()),
        "primitive_steps_per_second": {name: float(np.median([t.rate for t in of])) for name, of in turns.items()},
        "share_of_processor_time": {**share._asdict(), "bar": BAR, "reached": share.mean <= BAR},
        "rate_of_that_without": mean_interval(with_[:, 0] / without[:, 0])._asdict(),
    }


def large_buffer(folder: Path, seed: int, n: int, freq: int = TrainConfig.checkpoint_freq) -> dict[str, Any]:
    """A checkpoint of DQN whose replay buffer holds ``n`` transitions, after ``freq`` new ones.

    The rows are random numbers: none equals another, as little as in a task with continuous observations.
    """
    config = configure(algo="dqn", seed=seed, device="cpu", checkpoint_freq=freq, buffer_size=n)
    contestant = Contestant(config, folder)
    contestant.model.learn(1, contestant.callbacks)  # sets everything up
    buffer = cast("OptionReplayBuffer", cast("DQN", contestant.model).replay_buffer)
    n_bytes = fill(buffer, contestant.n_actions, np.random.default_rng(seed))
    # The last rollout of a `learn` writes none: a few steps more, so that each turn has its own.
    first, *others = (contestant.play(config.checkpoint_freq + EXTRA) for _ in range(1 + LATER))
    contestant.close()
    written = sum(turn.written for turn in others)
    spent = sum(turn.in_checkpoints for turn in others)
    share = spent / sum(turn.seconds for turn in others)
    return {
        "transitions": n,
        "new_transitions": config.checkpoint_freq,
        "megabytes": n_bytes / 1e6,
        "checkpoints_written": written,
        "seconds_of_the_first": first.in_checkpoints,
        "seconds_of_one": spent / written,
        "share_of_processor_time": {"mean": share, "bar": BAR, "reached": share <= BAR},
    }


def fill(buffer: OptionReplayBuffer, n_actions: int, random: np.random.Generator) -> int:
    """Let a buffer be full of random rows.

    Returns:
        Their bytes.
    """
    buffer.full = True
    for rows in (*buffer._observations.values(), *buffer._next_observations.values()):
        rows[:] = random.random(rows.shape, dtype=np.float32)
    buffer.actions[:] = random.integers(n_actions, size=buffer.actions.shape)
    buffer.rewards[:] = random.random(buffer.rewards.shape, dtype=np.float32)
    buffer.discounts[:] = 1
    return sum(column.nbytes for column in buffer._columns())


def table(costs: dict[str, dict[str, Any]]) -> Table:
    """What `measure` found, by scenario."""
    rows = Table("", "checkpoints", "share of the processor time", "bar")
    for scenario, of in costs.items():
        share = of["share_of_processor_time"]
        rows.add_row(scenario, str(of["checkpoints_written"]), f"{share['mean']:.2%}", f"≤ {share['bar']:.0%}")
    return rows
