"""Environments of a run, and the run folder."""

from __future__ import annotations

import difflib
import importlib
import json
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, Literal, TypeAlias

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_options.atomic import atomic_write, remove_stale
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.envs import minigrid
from sb3_options.execution.ray_vec_env import RayVecEnv
from sb3_options.execution.workers import watched_workers
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.options import file as option_file
from sb3_options.options.archive import NAME
from sb3_options.options.bank import OptionBank
from sb3_options.runs import yaml_file
from sb3_options.runs.config import CONFIG as CONFIG
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.eval_callback import BEST as BEST
from sb3_options.runs.interrupts import ignore_interrupts
from sb3_options.runs.users_code import feature_map_of, imported, named, named_in_errors

MODEL = "model.zip"
OPTIONS = NAME
CHECKPOINTS = "checkpoints"
MONITOR = "monitor"
SUBGOALS = "subgoals.png"

ALIKE = 0.6
"""Least similarity of an id that is suggested in place of another, as `difflib` measures it."""

VecEnvKind: TypeAlias = Literal["dummy", "subproc", "ray"]
"""Where environments live."""

OWN_NAMESPACE = "sb3_options/"
"""Of the environments that come with the library."""


def new_run_folder(config: TrainConfig) -> Path:
    """Make the next free folder ``ALGO/ENV_N`` below ``tensorboard_log``; clean those of killed runs."""
    with named_in_errors("--tensorboard-log", config.tensorboard_log, "cannot hold run folders"):
        parent = config.tensorboard_log / config.algo
        parent.mkdir(parents=True, exist_ok=True)
        remove_stale(parent, "*/")
        for number in count(1):
            folder = parent / f"{config.env.replace('/', '-')}_{number}"
            with suppress(FileExistsError):
                folder.mkdir()
                break
    return folder


def discard(folder: Path) -> None:
    """Remove a run folder that nothing was trained in, and that of the algorithm where it is the only one."""
    shutil.rmtree(folder)
    with suppress(OSError):  # there are other runs
        folder.parent.rmdir()


def check_env_id(env_id: str) -> None:
    """Refuse an id that Gymnasium does not know, and name the package that registers it, or a similar id."""
    if minigrid.is_minigrid(env_id):
        minigrid.require()
    # An id may name the module that registers it, as in "module:Env-v0".
    module, colon, _ = env_id.rpartition(":")
    if colon:
        imported(module, "--env")
    if env_id in gym.registry or colon:
        return
    near = difflib.get_close_matches(env_id, gym.registry, n=1, cutoff=ALIKE)
    hint = f"Did you mean {near[0]!r}?" if near else "If a package registers it, name its module: --env module:ID."
    raise ValueError(f"There is no environment {env_id!r}. {hint}")


def _spec_of(env_id: str) -> EnvSpec:
    """What is registered under an id, which may name the module that registers it."""
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    return gym.spec(name)


def options_file(config: TrainConfig) -> Path | None:
    """The file behind ``--options``, if it fits ``--max-options``; None where there is none."""
    if config.options is None:
        return None
    path = config.options / OPTIONS if config.options.is_dir() else config.options
    if not path.is_file():
        raise FileNotFoundError(f"--options: there is no options file at {path}.")
    needed = 1 + max(option_file.slots_of(path), default=-1)
    if needed > config.max_options:
        raise ValueError(
            f"--options: {path} has an option in slot {needed - 1}, --max-options {config.max_options} is too few for "
            f"it: pass --max-options {needed} or more."
        )
    return path


def options_of(run: Path) -> Path | None:
    """Where the options came from that a run started with."""
    options = yaml_file.read_mapping(run / CONFIG).get("options")
    return None if options is None else Path(str(options))


def save_whole(model: BaseAlgorithm, path: Path) -> None:
    """Replace a ``model.zip`` when all of it is written."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:  # SB3 leaves its own open where a disk is full
        model.save(file)


def save(model: BaseAlgorithm, bank: OptionBank, folder: Path) -> None:
    """Save model and options; where one cannot be written, the other is, and a note says which is missing.

    Where there is no room for the model, older checkpoints make room.
    """

    def save_model(path: Path) -> None:
        try:
            save_whole(model, path)
        except OSError:
            CheckpointFolder(folder / CHECKPOINTS).make_room()
            save_whole(model, path)

    failed: list[Exception] = []
    for save, name in ((save_model, MODEL), (bank.save, OPTIONS)):
        try:
            save(folder / name)
        except Exception as error:
            error.add_note(f"So there is no {name} of this training.")
            failed.append(error)
    if failed:
        for other in failed[1:]:
            failed[0].add_note(" ".join([f"{other}.", *other.__notes__]))
        raise failed[0]


def make_env(
    config: TrainConfig,
    n_envs: int,
    seed: int,
    *,
    monitor_dir: Path | None = None,
    beneath: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None,
    render_mode: str | None = None,
    vec_env: VecEnvKind = "dummy",
    max_steps: int = 0,
) -> VecEnv:
    """Environments with option slots, and a ``Monitor`` beneath these, so that it counts primitive steps.

    The slots start with the options of ``--options``. An environment of MiniGrid gets a `MiniGridWrapper`, unless
    ``--env-wrapper`` names another.
    """
    keywords = config.env_kwargs | ({} if render_mode is None else {"render_mode": render_mode})
    if max_steps:
        own = keywords.get("max_episode_steps", _spec_of(config.env).max_episode_steps)
        # Beneath the Monitor, for SB3 counts the episodes that a Monitor reports.
        keywords = keywords | {"max_episode_steps": max_steps if own is None else min(own, max_steps)}
    options = options_file(config)

    elsewhere, classes = vec_env != "dummy", {"dummy": DummyVecEnv, "subproc": watched_workers, "ray": RayVecEnv}
    override = monitor_dir is None or not monitor_dir.exists()
    if vec_env == "ray" and monitor_dir is not None:
        _begin_monitors(monitor_dir, n_envs, config.env)
        override = False  # an environment that starts anew goes on with its file

    def with_options(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        if elsewhere:
            ignore_interrupts()
        if beneath is not None:
            env = beneath(env)
        return OptionsWrapper(
            env,
            config.max_options,
            gamma=config.gamma,
            feature_map=feature_map_of(config.feature_map),
            options_file=options,
            check_finite=True,
        )

    def wrapped(**kwargs: Any) -> gym.Env[Any, Any]:
        return minigrid.make(env_id, **kwargs) if wrapper is None else wrapper(gym.make(env_id, **kwargs))

    env_id = config.env
    wrapper: Callable[..., gym.Env[Any, Any]] | None = None
    if config.env_wrapper is not None:
        wrapper = named(config.env_wrapper, "--env-wrapper")
    if minigrid.is_minigrid(env_id):
        env_id = minigrid.qualified(env_id)  # nobody has registered it in a worker
    elif elsewhere and env_id.startswith(OWN_NAMESPACE):
        env_id = f"sb3_options.envs:{env_id}"  # nobody has registered it there

    return make_vec_env(
        wrapped if wrapper is not None or minigrid.is_minigrid(env_id) else env_id,
        n_envs=n_envs,
        seed=seed,
        env_kwargs=keywords,
        wrapper_class=with_options,
        monitor_dir=None if monitor_dir is None else str(monitor_dir),
        monitor_kwargs={"override_existing": override},
        vec_env_cls=classes[vec_env],  # type: ignore[arg-type]  # it makes one, too
    )


def _begin_monitors(folder: Path, n_envs: int, env_id: str) -> None:
    """Write the heads of new files of ``Monitor``: one that appends writes none."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(n_envs):
        path = folder / f"{i}.{Monitor.EXT}"
        if not path.exists():
            head = json.dumps({"t_start": time.time(), "env_id": env_id})
            path.write_text(f"#{head}\nr,l,t\n", encoding="utf-8")
