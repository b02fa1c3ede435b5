"""Reads untrusted YAML as plain values: it can run nothing, import nothing, and takes little time."""

import re
from collections import Counter
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import yaml

from sb3_options.atomic import atomic_write

MAX_CHARACTERS = 100_000  # maximum characters read. PyYAML takes about a second for them.
MAX_DEPTH = 20  # maximum nesting

SCIENTIFIC = re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")
"""YAML 1.2 numbers that PyYAML, which follows 1.1, takes for text: 1e4, 3e-4."""


class Loader(yaml.SafeLoader):
    """PyYAML's safe loader, which also reads `SCIENTIFIC` numbers, and refuses duplicate names."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Return the values of a mapping by name; refuse duplicate names."""
        keys = (key for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for (_, name), n in Counter((key.tag, key.value.replace("-", "_")) for key in keys).items():
            if n > 1:
                raise ValueError(f"it has {name!r} twice; give it once.")
        return super().construct_mapping(node, deep)


class Dumper(yaml.SafeDumper):
    """PyYAML's safe dumper, which quotes text that `Loader` would take for numbers."""


for each in (Loader, Dumper):
    each.add_implicit_resolver("tag:yaml.org,2002:float", SCIENTIFIC, list("-+0123456789"))


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file of ``name: value`` lines; an empty file has none."""
    try:
        with path.open(encoding="utf-8") as file:
            content = parse(file.read(MAX_CHARACTERS + 1))
    except ValueError as error:
        raise ValueError(f"{path} is no YAML that can be read safely: {error}") from error
    if not isinstance(content, dict | None):
        raise ValueError(f"{path} must hold `name: value` lines, got a {type(content).__name__}.")
    return content or {}


def parse(text: str) -> Any:
    """Parse plain values. Refuse tags, which choose how a value is made, and aliases, which multiply values."""
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"it has more than {MAX_CHARACTERS:,} characters.")
    depth = 0
    try:
        for event in yaml.parse(text, Loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            special = getattr(event, "tag", None) or getattr(event, "anchor", None)
            if special or depth > MAX_DEPTH:
                what = f"the tag or anchor {special!r}" if special else f"more than {MAX_DEPTH} levels"
                raise ValueError(f"it has {what}; write plain values.")
        return yaml.load(text, Loader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Replace a YAML file once it is completely written."""
    with atomic_write(path) as temporary:
        temporary.write_text(dump(content, sort_keys=False), encoding="utf-8")


def dump(content: Mapping[str, Any], *, sort_keys: bool = True) -> str:
    """Return values as YAML that `parse` reads back."""
    return yaml.dump(content, Dumper=Dumper, sort_keys=sort_keys)
