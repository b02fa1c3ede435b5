"""Processor time per phase of training: environment, policy, options, discovery and learning."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from rich.progress import track
from rich.table import Table
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs.minigrid import DISCOVERY
from sb3_options.envs.minigrid import make as make_minigrid

PHASES = ("environment", "policy", "options", "discovery", "learning")
"""``policy`` is all that is in no other phase: choosing actions, and SB3's own loop and buffers."""

TASKS: dict[str, tuple[Callable[[], gym.Env[Any, Any]], dict[str, Any]]] = {
    "TwoRooms": (lambda: gym.make("sb3_options/TwoRooms-v0"), {}),
    "MiniGrid": (lambda: make_minigrid("MiniGrid-MultiRoom-N2-S4-v0"), DISCOVERY),
}
ALGORITHMS: dict[str, tuple[type[Any], dict[str, Any]]] = {
    "dqn": (DQN, {"learning_starts": 500, "batch_size": 64, "buffer_size": 20_000}),
    "ppo": (PPO, {"n_steps": 512, "device": "cpu"}),
    "maskable_ppo": (MaskablePPO, {"n_steps": 512, "device": "cpu"}),
}


class Stopwatch:
    """Adds up processor time by phase; a phase within another one does not count for that."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._within = ["policy"]
        self._since = time.process_time()

    def lap(self) -> None:
        """Note the time since the last lap for the phase that runs."""
        now = time.process_time()
        self.seconds[self._within[-1]] += now - self._since
        self._since = now

    def watch(self, phase: str, of: Any, *names: str) -> None:
        """Count methods of an object for a phase."""

        def watched(method: Callable[..., Any]) -> Callable[..., Any]:
            def run(*args: Any, **kwargs: Any) -> Any:
                self.lap()
                self._within.append(phase)
                try:
                    return method(*args, **kwargs)
                finally:
                    self.lap()
                    self._within.pop()

            return run

        for name in names:
            setattr(of, name, watched(getattr(of, name)))


def measure(steps: int, seed: int) -> dict[str, dict[str, float]]:
    """Microseconds per primitive step by phase, of every algorithm in every task, stock and with options."""
    runs = [(task, of, kind) for task in TASKS for of in ALGORITHMS for kind in ("stock", "options")]
    runs.remove(("TwoRooms", "maskable_ppo", "stock"))  # the same as PPO: there are no masks
    runs.remove(("MiniGrid", "maskable_ppo", "stock"))
    return {" ".join(run): _phases(*run, steps, seed) for run in track(runs, description="phases")}


def _phases(task: str, algorithm: str, kind: str, steps: int, seed: int) -> dict[str, float]:
    make, how = TASKS[task]
    of, settings = ALGORITHMS[algorithm]
    discovers = kind == "options"
    if discovers and of is DQN:
        settings = {**settings, "replay_buffer_class": OptionReplayBuffer}
    venv = make_vec_env(make, 1, seed=seed, wrapper_class=OptionsWrapper if discovers else None)
    model = of("MlpPolicy", venv, seed=seed, **settings)
    callback = SubgoalDiscoveryCallback(**how) if discovers else None
    stopwatch = Stopwatch()
    outer: Any = venv.envs[0]  # type: ignore[attr-defined]  # it is a DummyVecEnv
    if callback is not None:
        stopwatch.watch("options", outer, "step", "reset", "action_masks")
        stopwatch.watch("discovery", callback, "on_step", "on_rollout_start", "on_rollout_end", "on_training_end")
        outer = outer.env
    stopwatch.watch("environment", outer, "step", "reset")
    stopwatch.watch("learning", model, "train")
    model.learn(steps, callback=callback)
    stopwatch.lap()
    venv.close()
    found = 0 if callback is None else len(callback.discoveries)
    return {**{p: 1e6 * stopwatch.seconds[p] / model.num_timesteps for p in PHASES}, "options_found": found}


def table(found: dict[str, dict[str, float]]) -> Table:
    """Microseconds per primitive step."""
    shown = Table("µs per primitive step", *PHASES, "sum", "options found")
    for run, phases in found.items():
        times = [phases[phase] for phase in PHASES]
        shown.add_row(run, *(f"{x:.0f}" for x in (*times, sum(times))), str(phases["options_found"]))
    return shown
