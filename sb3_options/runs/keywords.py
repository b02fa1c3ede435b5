"""Values on the command line: keyword arguments and whole numbers."""

from __future__ import annotations

import difflib
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import tyro
from gymnasium.envs.registration import load_env_creator

from sb3_options.envs import minigrid
from sb3_options.experience.success import success_rule
from sb3_options.runs import yaml_file

OF_MAKE = frozenset(inspect.signature(gym.make).parameters) - {"id", "kwargs"}
"""Keyword arguments that ``gymnasium.make`` takes for itself, besides the id."""

IDS = ("id", "env_id")
"""How a keyword argument would name another environment."""


def keywords_of(pairs: Any, given_for: str = "--env-kwargs") -> Any:
    """Pairs ``name:value`` as keyword arguments; a value is read as YAML, so that 3 is a number, or it is None.

    Args:
        pairs: Of the command line or a file; a mapping is let be.
        given_for: The flag.

    Raises:
        ValueError: A pair has no colon, or a value is no YAML that can be read safely.
    """
    if not isinstance(pairs, str | list | tuple):
        return pairs  # a mapping, or what pydantic refuses
    keywords = {}
    for pair in [pairs] if isinstance(pairs, str) else pairs:
        name, colon, value = str(pair).partition(":")
        if not colon:
            raise ValueError(f"{given_for} takes pairs name:value, got {pair}.")
        try:
            keywords[name] = None if value == "None" else yaml_file.parse(value)
        except ValueError as error:
            raise ValueError(
                f"{given_for}: the value of {name!r} is no YAML that can be read safely: {error}"
            ) from error
    return keywords


def rule_of(text: str) -> str:
    """The text of ``--success``, if it names a rule.

    Raises:
        ValueError: It does not.
    """
    success_rule(text)
    return text


def algo_keywords_of(pairs: Any) -> Any:
    """As `keywords_of`, for ``--algo-kwargs``."""
    return keywords_of(pairs, "--algo-kwargs")


PAIRS = tyro.constructors.PrimitiveConstructorSpec[dict[str, Any]](
    nargs="*",
    metavar="[NAME:VALUE ...]",
    instance_from_str=keywords_of,
    is_instance=lambda value: isinstance(value, dict),
    # JSON is YAML on one line.
    str_from_instance=lambda keywords: [f"{name}:{json.dumps(value)}" for name, value in keywords.items()],
)
"""How the command line spells keyword arguments."""


def check_keywords(
    env_id: str, keywords: Mapping[str, Any], given_for: str = "--env-kwargs", *, wrapper: str | None = None
) -> None:
    """Refuse keyword arguments that the environment's constructor does not have, and name those that it has.

    Passed over is an environment that takes any, or that cannot be found, which is refused elsewhere. Those of MiniGrid
    hand what they do not take on to `MiniGridEnv`, and take the arguments of `MiniGridWrapper` too.

    Args:
        env_id: Gymnasium's.
        keywords: For it.
        given_for: The flag.
        wrapper: The user's own, in place of `MiniGridWrapper`.

    Raises:
        ValueError: It has no such argument, or an argument would name another environment.
    """
    if not set(keywords) - OF_MAKE:
        return
    of_minigrid = minigrid.is_minigrid(env_id)
    for name in IDS if of_minigrid else IDS[:1]:
        if name in keywords:
            raise ValueError(
                f"{given_for} takes arguments of --env {env_id}, {name!r} would name another environment. Train there "
                "on its own, and go on with the options of this run: --env ID --options RUN."
            )
    try:
        if of_minigrid:
            minigrid.require()
        maker = gym.spec(env_id.removeprefix(minigrid.MODULE)).entry_point
        creator: Any = load_env_creator(maker) if isinstance(maker, str) else maker or gym.make
        takes = _taken(inspect.getmro(creator) if of_minigrid else [creator])
    except (gym.error.Error, ImportError, AttributeError, TypeError, ValueError):
        return
    if takes is None:
        return
    if of_minigrid:
        takes = [name for name in takes if name != "mission_space"]  # each has its own
        takes += [] if wrapper is not None else minigrid.KEYWORDS
    for name in keywords:
        if name not in takes and name not in OF_MAKE:
            hint = "".join(f" Did you mean {near!r}?" for near in difflib.get_close_matches(name, takes, n=1))
            raise ValueError(f"{given_for}: {env_id} takes no {name!r}.{hint} It takes {', '.join(takes) or 'none'}.")


def _taken(makers: Sequence[Callable[..., Any]]) -> list[str] | None:
    """The arguments of the first of these, and of those that it hands others on to; None where the last takes any."""
    taken: dict[str, None] = {}
    for maker in makers:
        parameters = inspect.signature(maker).parameters.values()
        taken |= {each.name: None for each in parameters if each.kind is not each.VAR_KEYWORD}
        if not any(each.kind is each.VAR_KEYWORD for each in parameters):
            return list(taken)
    return None


def whole_number(text: str) -> int:
    """A whole number, also written as 1e4.

    Raises:
        ValueError: It is none.
    """
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = float(text)
        if number == int(number):
            return int(number)
    except (ValueError, OverflowError):
        pass
    raise ValueError(f"a whole number is expected, such as 5000 or 5e3, not {text!r}")


NUMBERS = tyro.constructors.ConstructorRegistry()
"""How the command line reads numbers."""


@NUMBERS.primitive_rule
def _whole_numbers(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[int] | None:
    if info.type is not int:
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: whole_number(words[0]),
        is_instance=lambda value: isinstance(value, int) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )
