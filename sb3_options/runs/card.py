"""The card of a run: what was trained, which options were discovered and how to use them, beside the options file."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter

from sb3_options.atomic import atomic_write
from sb3_options.embedding.settings import LEARNED
from sb3_options.envs.minigrid import is_minigrid
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.options.option import SubgoalOption
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import LOCATIONS
from sb3_options.runs.closing import measures
from sb3_options.runs.config import GROUPS, HOW_IT_RAN, TrainConfig
from sb3_options.runs.inspection import Contents, contents_of, subgoal_of

CARD = "README.md"
"""What a model hub shows as the model's page."""

PACKAGES = ("sb3-options", "stable-baselines3", "sb3-contrib", "torch", "gymnasium", "numpy")

NOT_TOLD = HOW_IT_RAN | {"algo", "env", "seed"}
"""Settings that say nothing of what was learned, or are said elsewhere."""


def write_card(folder: Path, config: TrainConfig, history: Sequence[EpisodeRecord], found: Mapping[int, int]) -> None:
    """Write the card into the run folder, whose model and options are saved already.

    Args:
        folder: The run folder.
        config: Of the run.
        history: Its training episodes, in the order in which they ended.
        found: Primitive steps after which an option was discovered, by slot.

    Raises:
        OSError: It cannot be written.
    """
    text = card_of(config, history, contents_of(folder), found, picture=(folder / runs.SUBGOALS).is_file())
    with atomic_write(folder / CARD) as temporary:
        temporary.write_text(text, encoding="utf-8")


def card_of(
    config: TrainConfig,
    history: Sequence[EpisodeRecord],
    contents: Contents,
    found: Mapping[int, int],
    *,
    picture: bool,
) -> str:
    """The card as Markdown.

    Args:
        config: Of the run.
        history: Its training episodes.
        contents: Of its options file.
        found: Primitive steps after which an option was discovered, by slot.
        picture: Whether ``subgoals.png`` lies beside it.
    """
    name = LOCATIONS[config.algo][1]
    changed = yaml.safe_dump(_changed(config), sort_keys=False)
    parts = [
        "---\nlibrary_name: stable-baselines3\ntags:\n- reinforcement-learning\n- options\n- sb3-options\n---",
        f"# {name} on {config.env}, with options",
        f"An agent of Stable-Baselines3 that also chooses options. Its budget was {config.n_timesteps:,} primitive "
        f"steps, its seed {config.seed}: one run, and no study.",
        "## Options",
        *_options(contents, found),
        *([f"![Subgoals, and what was seen]({runs.SUBGOALS})"] if picture else []),
        "## Training episodes, exploration included",
        _table(["", "this run"], [[key, value] for key, value in measures(history).items()]),
        "## Use",
        f"```python\n{_program(config)}\n```",
        f"`{runs.MODEL}` is unpickled by Stable-Baselines3. `{runs.OPTIONS}` holds the options alone, as arrays and "
        "JSON, for another agent: `train.py --options` or `OptionsWrapper(env, options_file=...)`.",
        "## Settings",
        f"Other than the defaults; `{runs.CONFIG}` has all of them.",
        f"```yaml\n{changed}```",
        _table(["package", "version"], [["Python", platform.python_version()], *_versions()]),
        f"SHA-256 of `{runs.OPTIONS}`: `{contents.digest}`",
    ]
    return "\n\n".join(parts) + "\n"


def _program(config: TrainConfig) -> str:
    """How to load the model with its options."""
    module, name = LOCATIONS[config.algo]
    imports = ["import gymnasium as gym", f"from {module} import {name}", "", "import sb3_options.envs"]
    imports.append("from sb3_options import OptionsWrapper, load_model")
    kwargs = "".join(f", {key}={value!r}" for key, value in config.env_kwargs.items())
    made = [f"env = gym.make({config.env!r}{kwargs})"]
    arguments = f"env, max_options={config.max_options}, gamma={config.gamma}"
    if config.env_wrapper is None and is_minigrid(config.env):
        imports.append("from sb3_options.envs.minigrid import make")
        made = [f"env = make({config.env!r}{kwargs})"]
    if config.env_wrapper is not None:
        module, _, of = config.env_wrapper.partition(":")
        imports.append(f"from {module} import {of}")
        made.append(f"env = {of}(env)")
    if config.feature_map == LEARNED:
        arguments += f", feature_map={config.feature_map!r}"
    elif config.feature_map is not None:
        module, _, of = config.feature_map.partition(":")
        imports.append(f"from {module} import {of}")
        arguments += f", feature_map={of}"
    load = f'model = load_model({name}, "{runs.MODEL}", OptionsWrapper({arguments}))'
    return "\n".join([*imports, "", *made, load])


def _changed(config: TrainConfig) -> dict[str, Any]:
    """Settings that differ from the defaults of environment and algorithm."""
    default = configs.made({"env": config.env, "algo": config.algo}, config.env)
    mine, usual = (TypeAdapter(type(config)).dump_python(each, mode="json") for each in (config, default))
    changed: dict[str, Any] = {}
    for name, value in mine.items():
        if name in GROUPS:
            value = {key: one for key, one in value.items() if one != usual[name][key]}
        if value != usual[name] and value != {} and name not in NOT_TOLD:
            changed[name] = value
    return changed


def _options(contents: Contents, found: Mapping[int, int]) -> list[str]:
    if not contents.options:
        return ["None was discovered."]
    rows = []
    for slot, option in contents.options.items():
        when = f"{found[slot]:,}" if slot in found else "given at the start"
        if isinstance(option, SubgoalOption):
            states = f"{len(option.initiation_set.points):,}"
            rows.append([str(slot), option.name, subgoal_of(option, contents.features), when, states])
        else:
            rows.append([str(slot), option, "made by hand: code, not in the file", when, ""])
    return [_table(["slot", "option", "subgoal", "found after primitive steps", "initiation states"], rows)]


def _table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _versions() -> list[list[str]]:
    found = []
    for package in PACKAGES:
        try:
            found.append([package, version(package)])
        except PackageNotFoundError:
            continue
    return found
