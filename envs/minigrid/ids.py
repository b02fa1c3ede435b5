"""MiniGrid environments by id."""

from __future__ import annotations

from typing import Any, Literal, overload

import gymnasium as gym

from sb3_options.envs.last_action import LastActionObservation
from sb3_options.envs.minigrid.wrapper import MiniGridWrapper
from sb3_options.extras import how_to_install

PREFIXES = ("MiniGrid-", "BabyAI-")  # of MiniGrid's ids

MODULE = "minigrid:"
"""Prefix of an id that names the module which registers it."""


@overload
def make(
    env_id: str, *, mission: bool = True, asked: bool = True, last_action: Literal[False] = False, **kwargs: Any
) -> MiniGridWrapper: ...


@overload
def make(
    env_id: str, *, mission: bool = True, asked: bool = True, last_action: bool, **kwargs: Any
) -> gym.Env[Any, Any]: ...


def make(
    env_id: str, *, mission: bool = True, asked: bool = True, last_action: bool = False, **kwargs: Any
) -> gym.Env[Any, Any]:
    """Make a MiniGrid environment by its id, in a `MiniGridWrapper`.

    Args:
        env_id: Id, such as ``MiniGrid-DoorKey-5x5-v0``.
        mission: As in `MiniGridWrapper`.
        asked: As in `MiniGridWrapper`.
        last_action: Whether to add a `LastActionObservation`.
        **kwargs: Arguments of ``gymnasium.make``.

    Raises:
        ModuleNotFoundError: The package ``minigrid`` is not installed.
    """
    require()
    env = MiniGridWrapper(gym.make(env_id, **kwargs), mission=mission, asked=asked)
    return LastActionObservation(env) if last_action else env


def is_minigrid(env_id: str) -> bool:
    """Whether an id is one of MiniGrid's."""
    return env_id.removeprefix(MODULE).startswith(PREFIXES)


def qualified(env_id: str) -> str:
    """Add the module to a MiniGrid id, so that it works in a process that has not registered it."""
    return MODULE + env_id.removeprefix(MODULE)


def require() -> None:
    """Import ``minigrid``, which registers its environments."""
    try:
        import minigrid  # noqa: F401  # registers them
    except ModuleNotFoundError as error:
        if error.name != "minigrid":
            raise
        raise ModuleNotFoundError(
            f"MiniGrid is not installed: {how_to_install('minigrid')}", name="minigrid"
        ) from error
