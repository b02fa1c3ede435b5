"""The models of the command line."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import inspect
import logging
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.embedding.encoders import MIN_IMAGE
from sb3_options.extras import how_to_install
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.runs.config import COMMON, DQNConfig, TrainConfig

logger = logging.getLogger("sb3_options")

LOCATIONS = {
    "dqn": ("stable_baselines3", "DQN"),
    "optiondqn": ("sb3_options.learning.dqn", "OptionDQN"),
    "ppo": ("stable_baselines3", "PPO"),
    "a2c": ("stable_baselines3", "A2C"),
    "qrdqn": ("sb3_contrib", "QRDQN"),
    "trpo": ("sb3_contrib", "TRPO"),
    "maskableppo": ("sb3_contrib", "MaskablePPO"),
    "recurrentppo": ("sb3_contrib", "RecurrentPPO"),
}
"""Module and name of the class behind each algorithm."""

CALLBACK = frozenset({"max_option_exploration", "interruption"})
"""Settings of some algorithms that `SubgoalDiscoveryCallback` takes."""

ELSEWHERE = CALLBACK | {"max_runs"}
"""Settings of some algorithms that their classes do not take."""

RESERVED = frozenset({"policy", "env", "verbose", "_init_setup_model"}) | {
    f"{kind}_buffer_{what}" for kind in ("replay", "rollout") for what in ("class", "kwargs")
}
"""Arguments of SB3's classes that are the library's affair."""


def make_model(config: TrainConfig, env: VecEnv, *, playing: bool = False) -> BaseAlgorithm:
    """The untrained model of a run.

    Args:
        config: Of the run.
        env: As `make_env` makes it.
        playing: Whether it is to be loaded and played only, which needs no large buffer.

    Returns:
        An SB3 model.

    Raises:
        ModuleNotFoundError: The algorithm is one of sb3-contrib's, which is not installed.
        ValueError: There is no such device, or no such argument in ``algo_kwargs``.
    """
    check_device(config.device)
    check_algorithm(config)
    space = env.observation_space
    # NatureCNN takes no smaller picture, such as a view of 7 x 7 cells.
    image = is_image_space(space) and min(sorted(space.shape or ())[1:]) >= MIN_IMAGE
    policy = "MultiInput" if isinstance(space, gym.spaces.Dict) else "Cnn" if image else "Mlp"
    own = {f.name for f in dataclasses.fields(config)} - COMMON - ELSEWHERE
    settings: dict[str, Any] = {name: getattr(config, name) for name in own} | config.algo_kwargs
    policy_kwargs = {"net_arch": list(config.net_arch)} | (settings.pop("policy_kwargs", None) or {})
    if isinstance(config, DQNConfig):
        # The rollout buffers of the others are the callback's affair.
        settings["replay_buffer_class"] = OptionReplayBuffer
        settings["replay_buffer_kwargs"] = {"n_steps": settings.pop("n_steps")}
    if playing:
        settings |= {"buffer_size": 1} if isinstance(config, DQNConfig) else {"n_steps": settings.get("batch_size", 1)}
    model: BaseAlgorithm = _class_of(config.algo)(
        f"{policy}{'Lstm' if config.algo == 'recurrentppo' else ''}Policy",
        env,
        seed=config.seed,
        device=config.device,
        gamma=config.gamma,
        learning_rate=config.learning_rate,
        policy_kwargs=policy_kwargs,
        **settings,
    )
    # SB3 seeds environment i with seed + i, so that the runs of seeds 0 and 1 would share all but one of them.
    env.seed(config.seed * env.num_envs)
    return model


def check_device(name: str) -> None:
    """Refuse a device that torch cannot compute on here. Without a GPU, "cuda" means "cpu", as SB3 has it.

    Raises:
        ValueError: There is no such device.
    """
    try:
        torch.zeros(1, device=get_device(name)).item()
    except Exception as error:  # torch and its backends raise what they like
        said = " ".join(str(error).split())
        raise ValueError(f"--device {name!r} cannot be used: choose auto, cpu or cuda. Torch says: {said}") from error


def warn_without_gpu(name: str) -> None:
    """Say that training is on the CPU where a GPU was asked for."""
    if name.startswith("cuda") and get_device(name).type == "cpu":
        logger.warning("--device %s: torch finds no GPU, so training is on the CPU.", name)


def check_algorithm(config: TrainConfig) -> None:
    """Refuse an algorithm that is not installed, and keyword arguments that it does not have or another setting gives.

    Raises:
        ModuleNotFoundError: The algorithm is one of sb3-contrib's, which is not installed.
        ValueError: There is such an argument in ``algo_kwargs``.
    """
    of = _class_of(config.algo)
    if not config.algo_kwargs:
        return
    own = {f.name for f in dataclasses.fields(config)}
    # OptionDQN hands on to DQN what it does not name.
    makers = (vars(each)["__init__"] for each in inspect.getmro(of) if "__init__" in vars(each))
    taken = next(names for each in makers if "learning_rate" in (names := inspect.signature(each).parameters))
    takes = sorted(set(taken) - own - RESERVED - {"self"})
    for name in config.algo_kwargs:
        if name in own:
            raise ValueError(f"--algo-kwargs: {name!r} is a setting of its own, --{name.replace('_', '-')}.")
        if name not in takes:
            near = difflib.get_close_matches(name, takes, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"--algo-kwargs: {of.__name__} takes no {name!r} here.{hint} It takes {', '.join(takes)}.")
    policy = config.algo_kwargs.get("policy_kwargs", {})
    if not isinstance(policy, dict):
        raise ValueError("--algo-kwargs: policy_kwargs takes a mapping, policy_kwargs:'{ortho_init: false}'.")
    for name, value in policy.items():
        if name.endswith(("_class", "_fn")) and value is not None:
            raise ValueError(
                f"--algo-kwargs: policy_kwargs takes numbers, texts and lists here; {name} is a class or a function, "
                f"which a script gives, got {value!r}."
            )


def callback_settings(config: TrainConfig) -> dict[str, Any]:
    """What `SubgoalDiscoveryCallback` is told of an algorithm."""
    return {f.name: getattr(config, f.name) for f in dataclasses.fields(config) if f.name in CALLBACK}


def _class_of(name: str) -> Any:
    module, class_name = LOCATIONS[name]
    try:
        return getattr(importlib.import_module(module), class_name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{class_name} needs sb3-contrib: {how_to_install('contrib')}") from error
