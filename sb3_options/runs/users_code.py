"""Code and files that a user names on the command line."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from sb3_options.embedding.settings import LEARNED

IMPORTING = {"env": "environment", "env_wrapper": "wrapper", "feature_map": "feature map"}
"""Settings that may import a module, and what each is: only the command line is trusted with them."""


def importing(values: Mapping[str, Any]) -> dict[str, str]:
    """Those of the settings ``values`` that would import a module, by name."""
    texts = {name: str(values.get(name) or "") for name in IMPORTING}
    if texts["feature_map"] == LEARNED:
        del texts["feature_map"]  # one that is learned
    # GymV21Environment and GymV26Environment make what their env_id names.
    return {n: t for n, t in texts.items() if (":" in t or t.startswith("GymV") if n == "env" else t)}


def with_trusted(values: Mapping[str, Any], trusted: Mapping[str, str | None], source: str | Path) -> dict[str, Any]:
    """Settings of a file, with those that the command line names in their place."""
    named = {name: value for name, value in trusted.items() if value is not None}
    for name, text in importing(values).items():
        if name not in named:
            raise ValueError(
                f"{source} names the {IMPORTING[name]} {text!r}, which would import a module. If you trust it, pass "
                f"{flag(name)} {text}."
            )
    return {**values, **named}


def flag(name: str) -> str:
    """How the command line spells a setting."""
    return f"--{name.replace('_', '-')}"


def feature_map_of(text: str | None) -> Any:
    """The feature map that ``--feature-map`` names: of a module, or one that is learned, by its name."""
    if text is None or text == LEARNED:
        return text
    if ":" not in text:
        raise ValueError(f"--feature-map takes module:name, or {LEARNED}, which is learned; got {text!r}.")
    return named(text, "--feature-map")


def named(text: str, source: str) -> Callable[..., Any]:
    """What ``module:name`` names."""
    module, _, name = text.partition(":")
    if not (module and name):
        raise ValueError(f"{source} takes module:name, got {text!r}.")
    found = getattr(imported(module, source), name, None)
    if not callable(found):
        raise ValueError(f"{source}: the module {module} has nothing named {name} that can be called.")
    return found  # type: ignore[no-any-return]  # of a user's module


def imported(module: str, source: str) -> ModuleType:
    """Import a module that the command line names. The current folder is not searched."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # it was found, and imports another
        raise ModuleNotFoundError(
            f"{source}: {error}. One in the current folder is found with PYTHONPATH=. before the command, or by "
            "`python -m sb3_options`.",
            name=error.name,
        ) from error


@contextmanager
def named_in_errors(source: str, path: Path, problem: str = "cannot be read") -> Iterator[None]:
    """Say of an error of the operating system which flag or command named the file."""
    try:
        yield
    except OSError as error:
        # The system may have stumbled over another one, such as a folder above.
        at = "" if error.filename is None or Path(error.filename) == path else f" ({error.filename})"
        text = f"{source} {path} {problem}: {error.strerror or error}{at}. Name another one."
        raise type(error)(text) from error
