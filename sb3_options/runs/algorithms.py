"""The algorithms of the command line: which settings each knows, and where its class is."""

from __future__ import annotations

import importlib
from typing import Any, Literal, TypeAlias, get_args

AlgorithmName: TypeAlias = Literal["dqn", "qrdqn", "optiondqn", "ppo", "a2c", "trpo", "maskableppo", "recurrentppo"]

_OFF_POLICY = frozenset(
    {
        "buffer_size",
        "learning_starts",
        "batch_size",
        "train_freq",
        "target_update_interval",
        "exploration_fraction",
        "exploration_final_eps",
    }
)
_PPO = frozenset({"n_steps", "batch_size", "n_epochs", "gae_lambda", "ent_coef", "clip_range"})

SETTINGS: dict[str, frozenset[str]] = {
    "dqn": _OFF_POLICY,
    "qrdqn": _OFF_POLICY,
    "optiondqn": _OFF_POLICY,
    "ppo": _PPO,
    "a2c": frozenset({"n_steps", "gae_lambda", "ent_coef"}),
    "trpo": frozenset({"n_steps", "batch_size", "gae_lambda"}),
    "maskableppo": _PPO,
    "recurrentppo": _PPO,
}
"""Fields of `TrainConfig` that an algorithm's class knows besides ``gamma``, ``learning_rate`` and ``net_arch``."""

OFF_POLICY = tuple(name for name, settings in SETTINGS.items() if settings is _OFF_POLICY)
ON_POLICY = tuple(name for name in get_args(AlgorithmName) if name not in OFF_POLICY)

_OPTION_SETTINGS: dict[str, frozenset[str]] = {
    "maskableppo": frozenset({"max_option_exploration", "max_runs"}),
    **dict.fromkeys(OFF_POLICY, frozenset({"max_option_exploration", "interruption", "intra_option"})),
}
"""Fields that say how an algorithm handles options, beyond what all of them do."""

EVERY_SETTING = frozenset().union(*SETTINGS.values(), *_OPTION_SETTINGS.values())

_CLASSES = {
    "dqn": ("stable_baselines3", "DQN"),
    "optiondqn": ("sb3_options.learning.dqn", "OptionDQN"),
    "ppo": ("stable_baselines3", "PPO"),
    "a2c": ("stable_baselines3", "A2C"),
    "qrdqn": ("sb3_contrib", "QRDQN"),
    "trpo": ("sb3_contrib", "TRPO"),
    "maskableppo": ("sb3_contrib", "MaskablePPO"),
    "recurrentppo": ("sb3_contrib", "RecurrentPPO"),
}


def class_of(name: str) -> Any:
    """The class behind ``--algo``.

    Raises:
        ModuleNotFoundError: It is one of sb3-contrib's, which is not installed.
    """
    module, class_name = _CLASSES[name]
    try:
        return getattr(importlib.import_module(module), class_name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{class_name} needs sb3-contrib: pip install 'sb3-options[contrib]'") from error


def known_to(name: str) -> frozenset[str]:
    """Fields of `TrainConfig` that are not for all algorithms, and are for this one."""
    return SETTINGS.get(name, frozenset()) | _OPTION_SETTINGS.get(name, frozenset())


def knowing(setting: str) -> list[str]:
    """The algorithms that know a setting."""
    return [name for name in SETTINGS if setting in known_to(name)]
