"""Code of the user's that the command line names: who may name it, and how it is found."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

from sb3_options.embedding.settings import SIZES, MapName
from sb3_options.execution.features import learned_name
from sb3_options.experience.observations import FeatureMap

IMPORTING = {"env": "environment", "env_wrapper": "wrapper", "feature_map": "feature map"}
"""The settings that may import a module, and what each of them is: the command line alone is trusted with them."""


def importing(values: Mapping[str, Any]) -> dict[str, str]:
    """Those of the settings ``values`` that would import a module, by name."""
    texts = {name: str(values.get(name) or "") for name in IMPORTING}
    if texts["feature_map"] in SIZES:
        del texts["feature_map"]  # one that is learned
    # GymV21Environment and GymV26Environment make what their env_id names.
    return {n: t for n, t in texts.items() if (":" in t or t.startswith("GymV") if n == "env" else t)}


def flag(name: str) -> str:
    """How the command line spells a setting."""
    return f"--{name.replace('_', '-')}"


def feature_map_of(text: str | None) -> FeatureMap | MapName | None:
    """The feature map that ``--feature-map`` names: of a module, or one that is learned, by its name.

    Raises:
        ModuleNotFoundError: There is no such module.
        ValueError: It names nothing that can be called.
    """
    if text is None:
        return None
    return learned_name(text) if text in SIZES else named(text, flag("feature_map"))


def named(text: str, given_for: str) -> Callable[..., Any]:
    """What ``module:name`` names.

    Args:
        text: From the command line, for it imports the module.
        given_for: The flag.

    Raises:
        ModuleNotFoundError: There is no such module.
        ValueError: It names nothing that can be called.
    """
    module, _, name = text.partition(":")
    if not (module and name):
        raise ValueError(f"{given_for} takes module:name, got {text!r}.")
    found = getattr(importlib.import_module(module), name, None)
    if not callable(found):
        raise ValueError(f"{given_for}: the module {module} has nothing named {name} that can be called.")
    return found  # type: ignore[no-any-return]  # of a user's module
