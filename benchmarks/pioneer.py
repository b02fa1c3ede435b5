"""What the Pioneer costs: primitive actions per second, and how much of a step is PyBullet's own work.

``python -m benchmarks.pioneer --out FOLDER`` lets three take turns in one process, so that a machine that slows down
slows all of them: the Pioneer as it is, the Pioneer with a stopwatch around each of PyBullet's C functions, and
panda-gym (Gallouédec et al. 2021), the PyBullet environments that people compare with. It writes ``results.json``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import panda_gym  # noqa: F401  # registers its environments
import pybullet
import tyro
from rich.table import Table

from benchmarks.turns import take_turns
from experiments.common.study import show, write
from sb3_options.envs.pioneer.body import CONTROL_RATE, PHYSICS_RATE
from sb3_options.envs.pioneer.env import Pioneer
from sb3_options.runs.intervals import mean_interval

PEER = "PandaPush-v3"
"""A robot pushes an object, and the reward does not depend on a picture: the nearest to our task."""

OURS = "sb3_options/Pioneer-v0"

BAR = 0.75
"""Least share of a step's wall time inside PyBullet's C functions."""

SHARES = ("pybullet_share_of_step", "panda_gym_pybullet_share_of_step")


@dataclass(frozen=True)
class Benchmark:
    """Time the Pioneer's primitive actions, and compare with panda-gym per physics step.

    Attributes:
        out: Folder for results.json.
        rounds: Turns.
        actions: Steps of each environment in a turn.
        seed: Of everything random.
    """

    out: Path
    rounds: int = 30
    actions: int = 200
    seed: int = 0


class Turn(NamedTuple):
    """What a turn of one environment took.

    Attributes:
        step: Wall time in ``step``, s.
        inside: Of it, inside PyBullet's C functions, s; 0 where nothing was measured.
        physics_steps: Physics steps simulated.
        n: Steps of the environment.
    """

    step: float
    inside: float
    physics_steps: int
    n: int


class Stopwatch:
    """Wraps C functions of PyBullet, and adds up the time inside of them and the calls of ``stepSimulation``.

    What a wrapper itself costs counts as time outside: the share it reports is too low rather than too high.
    """

    def __init__(self) -> None:
        self.inside = 0.0
        self.simulated = 0

    def module(self) -> SimpleNamespace:
        """A stand-in for the ``pybullet`` module, whose functions are timed."""
        names = {name: getattr(pybullet, name) for name in dir(pybullet) if not name.startswith("__")}
        return SimpleNamespace(**{n: self.timed(n, f) if type(f) is type(len) else f for n, f in names.items()})

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function with a stopwatch around."""
        simulates = name == "stepSimulation"

        def call(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            result = function(*args, **kwargs)
            self.inside += time.perf_counter() - began
            self.simulated += simulates
            return result

        return call


class Contestant:
    """An environment that takes random actions, with or without a stopwatch.

    Args:
        env: The environment.
        substeps: Physics steps in a call of ``stepSimulation``.
        seed: Of its episodes and actions.
        stopwatch: That of the PyBullet that it calls, if it has one.
    """

    def __init__(self, env: gym.Env[Any, Any], substeps: int, seed: int, stopwatch: Stopwatch | None = None) -> None:
        self._env, self._substeps, self._stopwatch = env, substeps, stopwatch
        self._env.action_space.seed(seed)
        self._env.reset(seed=seed)

    def turn(self, n: int) -> Turn:
        """Takes ``n`` random actions; the time of resets does not count."""
        step = inside = 0.0
        simulated = 0
        watch = self._stopwatch or Stopwatch()
        for _ in range(n):
            action = self._env.action_space.sample()
            inside_before, simulated_before, began = watch.inside, watch.simulated, time.perf_counter()
            _, _, terminated, truncated, _ = self._env.step(action)
            step += time.perf_counter() - began
            inside += watch.inside - inside_before
            simulated += watch.simulated - simulated_before
            if terminated or truncated:
                self._env.reset()
        return Turn(step, inside, simulated * self._substeps, n)

    def close(self) -> None:
        """Closes the environment."""
        self._env.close()


def contestants(seed: int) -> dict[str, Contestant]:
    """The Pioneer and its peer, each bare and with a stopwatch; the same seed gives both the same actions."""
    per_tick = PHYSICS_RATE // CONTROL_RATE
    timed_pioneer, pioneer_watch = gym.make(OURS), Stopwatch()
    core = timed_pioneer.unwrapped
    assert isinstance(core, Pioneer)
    core.simulator.p = pioneer_watch.module()
    timed_peer, peer_watch = gym.make(PEER), Stopwatch()
    # panda-gym calls a BulletClient, which looks each function up when it is called.
    client: Any = timed_peer.unwrapped.sim.physics_client  # type: ignore[attr-defined]  # panda-gym has no stubs
    for name in dir(pybullet):
        function = getattr(pybullet, name)
        # To look up "disconnect" makes a BulletClient forget its number.
        if type(function) is type(len) and name != "disconnect":
            setattr(client, name, peer_watch.timed(name, getattr(client, name)))
    return {
        "pioneer": Contestant(gym.make(OURS), per_tick, seed),
        "pioneer_timed": Contestant(timed_pioneer, per_tick, seed, pioneer_watch),
        "panda_gym": Contestant(gym.make(PEER), 1, seed),
        "panda_gym_timed": Contestant(timed_peer, 1, seed, peer_watch),
    }


def main(benchmark: Benchmark) -> None:
    """Run the benchmark, and write and print what it found."""
    players = contestants(benchmark.seed)
    for player in players.values():
        player.turn(min(benchmark.actions, 20))  # filled caches
    turns = take_turns(list(players), lambda name: players[name].turn(benchmark.actions), benchmark.rounds)
    for player in players.values():
        player.close()
    results = summarise(turns)
    command = f"python -m benchmarks.pioneer --rounds {benchmark.rounds} --actions {benchmark.actions}"
    write(benchmark.out, {"command": command, **results}, {})
    show(_table(results), f"Results: {benchmark.out / 'results.json'}")


def summarise(turns: dict[str, list[Turn]]) -> dict[str, Any]:
    """Means over turns with 95 % intervals; shares and ratios are taken within each turn.

    The bare environments give the rates, those with a stopwatch the shares and the physics steps, which are the same
    in both because the actions are.
    """
    n = len(turns["pioneer"])

    def interval(values: list[float]) -> dict[str, float]:
        return mean_interval(np.array(values))._asdict()

    results: dict[str, Any] = {
        "n_turns": n,
        "actions_per_turn": turns["pioneer"][0].n,
        "primitive_actions_per_second": interval([turn.n / turn.step for turn in turns["pioneer"]]),
        "physics_steps_per_action": interval([turn.physics_steps / turn.n for turn in turns["pioneer_timed"]]),
    }
    for share, name in zip(SHARES, ("pioneer_timed", "panda_gym_timed"), strict=True):
        results[share] = interval([turn.inside / turn.step for turn in turns[name]])
    results[SHARES[0]] |= {"bar": BAR, "reached": results[SHARES[0]]["mean"] >= BAR}
    per_physics_step = {}
    for name in ("pioneer", "panda_gym"):
        pairs = zip(turns[name], turns[f"{name}_timed"], strict=True)
        per_physics_step[name] = [1e6 * bare.step / timed.physics_steps for bare, timed in pairs]
        results[f"{name}_microseconds_per_physics_step"] = interval(per_physics_step[name])
    ratios = [ours / theirs for ours, theirs in zip(*per_physics_step.values(), strict=True)]
    results["pioneer_of_panda_gym_per_physics_step"] = interval(ratios)
    results["peer"] = PEER
    return results


def _table(results: dict[str, Any]) -> Table:
    table = Table("", "mean", "95 % interval")
    for name, value in results.items():
        if isinstance(value, dict):
            table.add_row(name, f"{value['mean']:.4g}", f"{value['low']:.4g} to {value['high']:.4g}")
    return table


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
