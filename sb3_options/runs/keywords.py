"""Values on the command line: pairs ``name:value``."""

from __future__ import annotations

import json
from typing import Any

import tyro

from sb3_options.runs import yaml_file


def keywords_of(pairs: Any, source: str = "--env-kwargs") -> Any:
    """Pairs ``name:value`` as keyword arguments; a value is read as YAML, so that 3 is a number."""
    if not isinstance(pairs, str | list | tuple):
        return pairs  # a mapping, or what pydantic refuses
    keywords = {}
    for pair in [pairs] if isinstance(pairs, str) else pairs:
        name, colon, value = str(pair).partition(":")
        if not colon:
            raise ValueError(f"{source} takes pairs name:value, got {pair}.")
        keywords[name] = value_of(name, value)
    return keywords


def value_of(name: str, text: str) -> Any:
    """A value of the command line, read as YAML; None is None."""
    try:
        return None if text == "None" else yaml_file.parse(text)
    except ValueError as error:
        raise ValueError(f"the value of {name!r} is no YAML that can be read safely: {error}") from error


PAIRS = tyro.constructors.PrimitiveConstructorSpec[dict[str, Any]](
    nargs="*",
    metavar="[NAME:VALUE ...]",
    instance_from_str=lambda words: keywords_of(words, "the flag"),
    is_instance=lambda value: isinstance(value, dict),
    # JSON is YAML on one line.
    str_from_instance=lambda keywords: [f"{name}:{json.dumps(value)}" for name, value in keywords.items()],
)
"""How the command line spells keyword arguments."""
