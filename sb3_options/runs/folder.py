"""Environments of a run, and the run folder."""

import fcntl
import importlib
import json
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_options.atomic import atomic_write, remove_stale
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.embedding.settings import LEARNED
from sb3_options.envs import minigrid
from sb3_options.execution.ray_vec_env import RayVecEnv
from sb3_options.execution.workers import watched_workers
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.options.archive import NAME
from sb3_options.options.bank import OptionBank
from sb3_options.runs.config import CONFIG as CONFIG
from sb3_options.runs.config import TrainConfig

MODEL = "model.zip"
BEST = "best_model.zip"
OPTIONS = NAME
CHECKPOINTS = "checkpoints"
MONITOR = "monitor"
SUBGOALS = "subgoals.png"

LOCK = ".training"  # lock file in the run folder, removed when training ends


def new_run_folder(config: TrainConfig) -> Path:
    """Make the next free folder ``ALGO/ENV_N`` below ``tensorboard_log``; clean up after killed runs."""
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
    """Remove the folder of an untrained run, and the folders above that become empty."""
    shutil.rmtree(folder)
    with suppress(OSError):  # there are other runs
        folder.parent.rmdir()
        folder.parents[1].rmdir()


@contextmanager
def held(run: Path) -> Iterator[None]:
    """Keep other processes from writing to a folder. A killed process releases the folder."""
    with os.fdopen(os.open(run / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"{run} is being trained by another process: wait until it ends, or end it.") from None
        except OSError:
            pass  # this file system has no locks
        try:
            yield
        finally:
            (run / LOCK).unlink(missing_ok=True)  # the folder may be gone


def named(text: str, source: str) -> Callable[..., Any]:
    """Import ``module:name`` from a user's module. The current folder is not searched."""
    module, _, name = text.partition(":")
    found: Any = getattr(importlib.import_module(module), name, None) if module and name else None
    if not callable(found):
        raise ValueError(f"{source} takes module:name of a class or function, got {text!r}.")
    return found  # type: ignore[no-any-return]  # of a user's module


def save(model: BaseAlgorithm, bank: OptionBank, folder: Path) -> None:
    """Save options and model, each completely or not at all. If the disk is full, remove older checkpoints."""
    try:
        bank.save(folder / OPTIONS)
    finally:
        try:
            save_whole(model, folder / MODEL)
        except OSError:
            CheckpointFolder(folder / CHECKPOINTS).make_room()
            save_whole(model, folder / MODEL)


def save_whole(model: BaseAlgorithm, path: Path) -> None:
    """Replace a ``model.zip`` once it is completely written."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:  # SB3 leaves its own open on a full disk
        model.save(file)


def make_env(
    config: TrainConfig,
    n_envs: int,
    seed: int,
    *,
    monitor_dir: Path | None = None,
    beneath: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None,
    render_mode: str | None = None,
    vec_env: Literal["dummy", "subproc", "ray"] = "dummy",
    max_steps: int | None = None,
) -> VecEnv:
    """Make environments with option slots, and a ``Monitor`` beneath them that counts primitive steps.

    The slots start with the options of ``--options``. A MiniGrid environment gets a `MiniGridWrapper`, unless
    ``--env-wrapper`` names another. An episode ends after ``max_steps`` if the id has no limit.
    """
    wrapper = None if config.env_wrapper is None else named(config.env_wrapper, "--env-wrapper")
    of_minigrid = minigrid.is_minigrid(config.env)
    env_id = config.env
    if of_minigrid:
        minigrid.require()
        env_id = minigrid.qualified(env_id)  # a worker has not registered it
    elif env_id.startswith("sb3_options/"):
        env_id = f"sb3_options.envs:{env_id}"  # nor this one

    def made(**kwargs: Any) -> gym.Env[Any, Any]:
        if of_minigrid and wrapper is None:
            env: gym.Env[Any, Any] = minigrid.make(env_id, **kwargs)
        else:
            env = gym.make(env_id, **kwargs)
            env = env if wrapper is None else wrapper(env)
        # Beneath the Monitor, because SB3 counts the episodes that a Monitor reports.
        unlimited = env.spec is None or env.spec.max_episode_steps is None
        return gym.wrappers.TimeLimit(env, max_steps) if max_steps and unlimited else env

    if monitor_dir is not None:
        _begin_monitors(monitor_dir, n_envs, config.env)
    feature_map: Any = config.feature_map
    if feature_map is not None and feature_map != LEARNED:
        feature_map = named(feature_map, "--feature-map")
    options = config.options
    if options is not None and options.is_dir():
        options /= OPTIONS

    def with_options(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        if vec_env != "dummy":  # a worker survives signals of its terminal, so its parent can save and then end it
            for number in (signal.SIGINT, signal.SIGHUP):
                signal.signal(number, signal.SIG_IGN)
        return OptionsWrapper(
            env if beneath is None else beneath(env),
            config.max_options,
            gamma=config.gamma,
            feature_map=feature_map,
            options_file=options,
            max_runs=config.max_runs,
            check_finite=True,
        )

    classes = {"dummy": DummyVecEnv, "subproc": watched_workers, "ray": RayVecEnv}
    return make_vec_env(
        made,
        n_envs=n_envs,
        seed=seed,
        env_kwargs=config.env_kwargs | ({} if render_mode is None else {"render_mode": render_mode}),
        wrapper_class=with_options,
        monitor_dir=None if monitor_dir is None else str(monitor_dir),
        monitor_kwargs={"override_existing": False},  # a resumed run or a restarted Ray actor appends
        vec_env_cls=classes[vec_env],  # type: ignore[arg-type]  # it makes one, too
    )


def _begin_monitors(folder: Path, n_envs: int, env_id: str) -> None:
    """Write the headers of new ``Monitor`` files: a ``Monitor`` that appends writes none."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(n_envs):
        path = folder / f"{i}.{Monitor.EXT}"
        if not path.exists():
            head = json.dumps({"t_start": time.time(), "env_id": env_id})
            path.write_text(f"#{head}\nr,l,t\n", encoding="utf-8")
