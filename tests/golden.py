"""Train small models at fixed seeds, and compare what comes out with what came out before, bit for bit.

    python -m tests.golden check                 every training against tests/golden.json
    python -m tests.golden check dqn-options     one of them
    python -m tests.golden write                 after a change of behaviour that is meant

A row of `check` says which of a training's weights, options and episode log differ. It exits with 1 if any does, and
with 3 if this machine or its libraries are not those of the file: then the numbers cannot be compared.
"""

import argparse
import hashlib
import json
import logging
import os
import platform
import sys
import tempfile
import warnings
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # sums over several threads need not repeat

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch
from safetensors.numpy import load_file
from sb3_contrib import QRDQN, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options import MacroQ, OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs import GridWorld
from sb3_options.envs.minigrid import DISCOVERY, make
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import FAST_DISCOVERY, SMALL_ROOMS

FILE = Path(__file__).with_suffix(".json")
GAMMA = 0.9
SAME, DIFFERENT, NOT_COMPARABLE = 0, 1, 3
PARTS = ("weights", "options", "log")

VALUE_BASED: dict[str, Any] = {
    "learning_starts": 100,
    "train_freq": 16,
    "batch_size": 16,
    "buffer_size": 5000,
    "learning_rate": 1e-3,
    "exploration_fraction": 1.0,
    "exploration_final_eps": 0.8,
    "policy_kwargs": {"net_arch": [16]},
}
ON_POLICY: dict[str, Any] = {"n_steps": 64, "learning_rate": 1e-4, "policy_kwargs": {"net_arch": [16]}}
SAMPLED: dict[str, Any] = {**ON_POLICY, "batch_size": 64, "n_epochs": 2}
RECURRENT: dict[str, Any] = {**SAMPLED, "policy_kwargs": {"net_arch": [16], "lstm_hidden_size": 8}}
STOCK_Q: dict[str, Any] = {**VALUE_BASED, "replay_buffer_class": OptionReplayBuffer}

# Copied for each model: QRDQN and others write into `policy_kwargs`.
ALGORITHMS: dict[str, tuple[Any, tuple[str, ...], dict[str, Any]]] = {
    "dqn": (DQN, ("MlpPolicy",), STOCK_Q),
    "qrdqn": (QRDQN, ("MlpPolicy",), STOCK_Q),
    "option-dqn": (OptionDQN, ("MlpPolicy",), VALUE_BASED),
    "macro-q": (MacroQ, (), {"epsilon": 0.8}),
    "ppo": (PPO, ("MlpPolicy",), SAMPLED),
    "a2c": (A2C, ("MlpPolicy",), ON_POLICY),
    "trpo": (TRPO, ("MlpPolicy",), {**ON_POLICY, "batch_size": 64}),
    "maskable-ppo": (MaskablePPO, ("MlpPolicy",), SAMPLED),
    "recurrent-ppo": (RecurrentPPO, ("MlpLstmPolicy",), RECURRENT),
}


class EpisodeLog(BaseCallback):
    """Digests every decision; an episode is its primitive steps, its discounted rewards, success and options used."""

    def __init__(self) -> None:
        super().__init__()
        self.digest = hashlib.sha256()
        self.episodes = 0
        self._running: list[list[Any]] = []

    def _on_training_start(self) -> None:
        self._running = [[0, 0.0, []] for _ in range(self.training_env.num_envs)]

    def _on_step(self) -> bool:
        for i, info in enumerate(self.locals["infos"]):
            ran = info["option"]
            episode = self._running[i]
            episode[0] += ran["duration"]
            episode[1] += float(self.locals["rewards"][i])
            if ran["index"] >= 0:
                episode[2].append((ran["index"], ran["duration"], str(ran["termination"])))
            if self.locals["dones"][i]:
                self.digest.update(repr((i, *episode, info.get("is_success"))).encode())
                self.episodes += 1
                self._running[i] = [0, 0.0, []]
        return True


def rooms(*, by_hand: bool = False, max_options: int = 4, **kwargs: Any) -> OptionsWrapper:
    """Two small rooms, with an option made by hand in slot 0 or without."""
    env = OptionsWrapper(GridWorld(map=SMALL_ROOMS, max_steps=150), max_options, gamma=GAMMA, **kwargs)
    if by_hand:
        env.bank.add(steady_option(1, max_duration=2), 0)
    return env


def finds_the_doorway(**kwargs: Any) -> SubgoalDiscoveryCallback:
    """The callback with settings that find the doorway in some ten episodes."""
    settings = {**FAST_DISCOVERY, "max_share": None, **kwargs.pop("settings", {})}
    return SubgoalDiscoveryCallback(settings, **{"max_new_options": 1, **kwargs})


Training = tuple[BaseAlgorithm, SubgoalDiscoveryCallback, int]


def without_options(name: str) -> Training:
    """Stock learning in a wrapped environment: every slot stays empty."""
    algorithm, policy, kwargs = ALGORITHMS[name]
    return (
        algorithm(*policy, rooms(), gamma=GAMMA, seed=1, **deepcopy(kwargs)),
        finds_the_doorway(max_new_options=0),
        1_000,
    )


def with_options(
    name: str, *, n_envs: int = 1, n_timesteps: int = 5_000, env: dict[str, Any] | None = None, **own: Any
) -> Training:
    """Learning over an option made by hand and one that is discovered; ``own`` is the algorithm's or the callback's."""
    algorithm, policy, kwargs = ALGORITHMS[name]
    callback = own.pop("callback", {})
    venv = DummyVecEnv([lambda: rooms(by_hand=True, **(env or {})) for _ in range(n_envs)])
    model = algorithm(*policy, venv, gamma=GAMMA, seed=1, **deepcopy({**kwargs, **own}))
    return model, finds_the_doorway(**callback), n_timesteps


def in_minigrid() -> Training:
    """Options on concept groups, in an environment that names them."""
    env = gym.Wrapper(make("MiniGrid-MultiRoom-N2-S4-v0"))
    venv = DummyVecEnv([lambda: OptionsWrapper(env, 2, gamma=0.99)])
    model = MaskablePPO("MlpPolicy", venv, gamma=0.99, seed=1, **deepcopy(SAMPLED))
    callback = SubgoalDiscoveryCallback(**DISCOVERY, max_new_options=1, use={"primitive_rollouts": True})
    return model, callback, 4_000


def learned_map(name: str) -> Training:
    """A feature map that is learned while the model trains."""
    embedding = {"updates": 100, "batch_size": 128}
    return with_options(
        "dqn",
        env={"feature_map": name},
        callback={"concepts": {"embedding": embedding}, "settings": {"goal_radius": 1.5}},
    )


TRAININGS: dict[str, Callable[[], Training]] = {
    **{name: lambda name=name: without_options(name) for name in ALGORITHMS},  # type: ignore[misc]  # bound early
    **{f"{name}-options": lambda name=name: with_options(name) for name in ALGORITHMS},  # type: ignore[misc]  # too
    "maskable-ppo-options": lambda: with_options("maskable-ppo", n_timesteps=8_000),
    "dqn-n-step": lambda: with_options("dqn", replay_buffer_kwargs={"n_steps": 3}),
    "option-dqn-envs": lambda: with_options("option-dqn", n_envs=3, n_timesteps=8_000),
    "maskable-ppo-envs": lambda: with_options("maskable-ppo", n_envs=3),
    "minigrid": in_minigrid,
    "temporal-distance": lambda: learned_map("temporal-distance"),
    "relative-novelty": lambda: with_options("dqn", callback={"method": "relative-novelty"}),
}


def digest_of(arrays: dict[str, Any]) -> str:
    """SHA-256 of arrays in their order."""
    digest = hashlib.sha256()
    for array in arrays.values():
        values = np.ascontiguousarray(array)
        digest.update(f"{values.dtype} {values.shape}".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def result_of(name: str) -> dict[str, Any]:
    """Train, and digest what came out."""
    torch.set_num_threads(1)
    model, discovery, n_timesteps = TRAININGS[name]()
    log = EpisodeLog()
    model.learn(n_timesteps, callback=[log, discovery])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "options.safetensors")
        discovery.bank.save(path)
        options = load_file(path)
    weights = {key: value.detach().cpu().numpy() for key, value in model.policy.state_dict().items()}
    return {
        "weights": digest_of(weights),
        "options": digest_of(dict(sorted(options.items()))),
        "log": log.digest.hexdigest(),
        "discovered": len(discovery.discoveries),
        "episodes": log.episodes,
    }


def fingerprint() -> dict[str, str]:
    """What the last bits depend on."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "stable_baselines3": stable_baselines3.__version__,
        "machine": platform.machine(),
        "capability": torch.backends.cpu.get_cpu_capability(),
    }


def check(names: list[str]) -> int:
    """Print a row for each training; the exit code of the command."""
    stored = json.loads(FILE.read_text("utf-8"))
    here = fingerprint()
    other = {key: (value, here[key]) for key, value in stored["fingerprint"].items() if value != here.get(key)}
    if other:
        print(f"Not comparable: {FILE.name} was written with other versions or on another machine: {other}")
        return NOT_COMPARABLE
    code = SAME
    for name in names:
        before, now = stored["trainings"].get(name), result_of(name)
        differing = ["is not in the file"] if before is None else [part for part in PARTS if before[part] != now[part]]
        if differing:
            code = DIFFERENT
        counts = f"{now['discovered']} discovered, {now['episodes']} episodes"
        print(f"{name:24}{'DIFFERS: ' + ', '.join(differing) if differing else 'equal':36}{counts}", flush=True)
    return code


def write(names: list[str]) -> int:
    """Store the trainings named; the others stay as they are."""
    stored = json.loads(FILE.read_text("utf-8")) if FILE.exists() else {}
    same_machine = stored.get("fingerprint") == fingerprint()
    trainings = stored["trainings"] if same_machine else {}
    for name in names if same_machine else TRAININGS:
        trainings[name] = result_of(name)
        print(f"{name:24}{trainings[name]['discovered']} discovered", flush=True)
    ordered = {name: trainings[name] for name in TRAININGS if name in trainings}
    FILE.write_text(json.dumps({"fingerprint": fingerprint(), "trainings": ordered}, indent=1) + "\n", "utf-8")
    return SAME


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.golden", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("do", choices=("check", "write"))
    parser.add_argument("names", nargs="*", help="trainings; by default all")
    arguments = parser.parse_args()
    unknown = set(arguments.names) - set(TRAININGS)
    if unknown:
        parser.error(f"unknown trainings: {', '.join(sorted(unknown))}; known: {', '.join(TRAININGS)}")
    names = arguments.names or list(TRAININGS)
    warnings.simplefilter("ignore")
    logging.getLogger("sb3_options").setLevel(logging.ERROR)
    return check(names) if arguments.do == "check" else write(names)


if __name__ == "__main__":
    sys.exit(main())
