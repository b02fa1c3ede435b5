"""Environments of MiniGrid by their ids."""

from __future__ import annotations

from typing import Any, Literal, overload

import gymnasium as gym

from sb3_options.envs.last_action import LastActionObservation
from sb3_options.envs.minigrid.wrapper import MiniGridWrapper
from sb3_options.extras import how_to_install

PREFIXES = ("MiniGrid-", "BabyAI-")
"""How the ids of MiniGrid begin."""

MODULE = "minigrid:"
"""Before an id: the module that registers it."""


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
    """An environment of MiniGrid by its id, in a `MiniGridWrapper`.

    Args:
        env_id: Such as ``MiniGrid-DoorKey-5x5-v0``.
        mission: As `MiniGridWrapper` has it.
        asked: As `MiniGridWrapper` has it.
        last_action: Whether it is in a `LastActionObservation`, too.
        **kwargs: Of ``gymnasium.make``.

    Raises:
        ModuleNotFoundError: The package ``minigrid`` is not installed.
    """
    require()
    env = MiniGridWrapper(gym.make(env_id, **kwargs), mission=mission, asked=asked)
    return LastActionObservation(env) if last_action else env


def is_minigrid(env_id: str) -> bool:
    """Whether it is one of MiniGrid's."""
    return env_id.removeprefix(MODULE).startswith(PREFIXES)


def qualified(env_id: str) -> str:
    """An id of MiniGrid with its module, so that it is known in a process where nobody has registered it."""
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
