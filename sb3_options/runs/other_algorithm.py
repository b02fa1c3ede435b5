"""A file of settings that was written for another algorithm than the one that is asked for."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from sb3_options.runs.config import CLASSES, COMMON, GROUPS, OnPolicyConfig, TrainConfig, made, names_of
from sb3_options.runs.users_code import flag

STAYS = frozenset({"algo", "env", *GROUPS})
"""What says the same of every algorithm, default or not."""


def carried_over(values: Mapping[str, Any], algo: str, given: Collection[str], where: str | Path) -> dict[str, Any]:
    """The settings of a file, as far as they say something of the algorithm that is asked for.

    The file of a run names every setting. One that has the default of the file's algorithm gives way to the default of
    the other. Within a family (on-policy or off-policy) the others hold. Of another family those do that every
    algorithm has, but for the learning rate.

    Args:
        values: Of the file, by name.
        algo: The algorithm that is asked for.
        given: Names of the settings that flags give, which win.
        where: The values come from, for errors.

    Raises:
        ValueError: A setting was chosen for an algorithm of the other family, where it means something else.
    """
    before = str(values.get("algo", algo)).lower()
    if before == algo or not {before, algo} <= set(CLASSES):
        return dict(values)
    env_id = str(values.get("env", TrainConfig.env))
    defaults = TypeAdapter(CLASSES[before]).dump_python(made({"env": env_id, "algo": before}, where), mode="json")
    chosen = {
        name: value
        for name, value in values.items()
        if name in STAYS or not (name in given or (name in defaults and value == defaults[name]))
    }
    if issubclass(CLASSES[before], OnPolicyConfig) != issubclass(CLASSES[algo], OnPolicyConfig):
        own = [n for n in chosen if n in names_of(algo) and (n not in COMMON or n == "learning_rate")]
        if own:
            said = " ".join(f"{flag(name)} {chosen[name]}" for name in own)
            raise ValueError(
                f"{where}: what was chosen for {before} says nothing of {algo}: {said}. Leave it out of the file, or "
                f"choose for {algo}: {' '.join(f'{flag(name)} N' for name in own)}."
            )
    return chosen
