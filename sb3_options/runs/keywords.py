"""Keyword arguments on the command line: of an environment, or of each task of a series."""

from __future__ import annotations

import json
from typing import Any

import tyro

from sb3_options.runs import yaml_file


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
