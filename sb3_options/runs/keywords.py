"""Values on the command line: keyword arguments of an environment or of each task of a series, and whole numbers."""

from __future__ import annotations

import difflib
import inspect
import json
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import tyro
from gymnasium.envs.registration import load_env_creator

from sb3_options.envs.minigrid import is_minigrid
from sb3_options.runs import yaml_file

OF_MAKE = frozenset(inspect.signature(gym.make).parameters)
"""Keyword arguments that ``gymnasium.make`` takes for itself."""


def keywords_of(pairs: Any, given_for: str = "--env-kwargs") -> Any:
    """Pairs ``name:value`` as keyword arguments; a value is read as YAML, so that 3 is a number.

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
            keywords[name] = yaml_file.parse(value)
        except ValueError as error:
            raise ValueError(
                f"{given_for}: the value of {name!r} is no YAML that can be read safely: {error}"
            ) from error
    return keywords


PAIRS = tyro.constructors.PrimitiveConstructorSpec[dict[str, Any]](
    nargs="*",
    metavar="[NAME:VALUE ...]",
    instance_from_str=keywords_of,
    is_instance=lambda value: isinstance(value, dict),
    # JSON is YAML on one line.
    str_from_instance=lambda keywords: [f"{name}:{json.dumps(value)}" for name, value in keywords.items()],
)
"""How the command line spells keyword arguments."""


def tasks_of(texts: Any) -> Any:
    """The keyword arguments of each task: a pair ``name:value``, or a mapping in YAML, ``{name: value, …}``.

    Raises:
        ValueError: A text is neither, or no YAML that can be read safely.
    """
    if not isinstance(texts, list | tuple):
        raise ValueError(f"series takes a list of tasks, each a pair name:value or a mapping, got {texts!r}.")
    return [_task_of(text) if isinstance(text, str) else text for text in texts]


def _task_of(text: str) -> Any:
    if not text.startswith("{"):
        return keywords_of(text, "--series")
    try:
        return yaml_file.parse(text)
    except ValueError as error:
        raise ValueError(f"--series: {text} is no YAML that can be read safely: {error}") from error


SERIES = tyro.constructors.PrimitiveConstructorSpec[tuple[dict[str, Any], ...]](
    nargs="*",
    metavar="[TASK ...]",
    instance_from_str=lambda texts: tuple(tasks_of(texts)),
    is_instance=lambda value: isinstance(value, tuple) and all(isinstance(task, dict) for task in value),
    str_from_instance=lambda tasks: [json.dumps(task) for task in tasks],
)
"""How the command line spells a series."""


def check_keywords(env_id: str, keywords: Mapping[str, Any], given_for: str = "--env-kwargs") -> None:
    """Refuse keyword arguments that the environment's constructor does not have, and name those that it has.

    Passed over is an environment that takes any, or that cannot be found, which is refused elsewhere.

    Args:
        env_id: Gymnasium's.
        keywords: For it.
        given_for: The flag.

    Raises:
        ValueError: It has no such argument.
    """
    if not set(keywords) - OF_MAKE or is_minigrid(env_id):
        return
    try:
        maker = gym.spec(env_id).entry_point
        takes = inspect.signature(load_env_creator(maker) if isinstance(maker, str) else maker or gym.make).parameters
    except (gym.error.Error, ImportError, AttributeError, TypeError, ValueError):
        return
    if any(each.kind is each.VAR_KEYWORD for each in takes.values()):
        return
    for name in keywords:
        if name not in takes and name not in OF_MAKE:
            hint = "".join(f" Did you mean {near!r}?" for near in difflib.get_close_matches(name, takes, n=1))
            raise ValueError(f"{given_for}: {env_id} takes no {name!r}.{hint} It takes {', '.join(takes) or 'none'}.")


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
