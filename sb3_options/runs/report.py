"""What came out of a run: the table at the end of training, the card of the run folder, the options of a file."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.atomic import atomic_write
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.discovery.settings import described
from sb3_options.options import file as option_file
from sb3_options.options.archive import NAME
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import yaml_file
from sb3_options.runs.commands import InspectConfig
from sb3_options.runs.compare import goal_of, learned_after, source_of
from sb3_options.runs.config import ALGORITHMS, GROUPS, HOW_IT_RAN, TrainConfig, is_minigrid
from sb3_options.runs.logged import Run, read_run
from sb3_options.runs.pictures import options_picture, save_picture
from sb3_options.runs.program import command, python, quoted
from sb3_options.runs.users_code import flag, importing

CARD = "README.md"
"""What a model hub shows as the model's page."""

LAST = 100
"""Episodes at the end of training that are averaged."""

PACKAGES = ("sb3-options", "stable-baselines3", "sb3-contrib", "torch", "gymnasium", "numpy")
HEADINGS = ("slot", "option", "subgoal", "found after primitive steps", "initiation states", "policy", "longest run")


class Trained(NamedTuple):
    """What is left of one training. The folder is gone if no step was taken; an interrupt may come after the end."""

    config: TrainConfig
    folder: Path
    discovery: SubgoalDiscoveryCallback
    finished: bool
    interrupted: bool

    @property
    def found(self) -> dict[int, int]:
        """Primitive steps after which an option was discovered, by slot."""
        return {each.slot: each.timestep for each in self.discovery.discoveries}


class Contents(NamedTuple):
    """What an options file holds, by slot; a hand-made option is a name only.

    ``observations`` (a space, in words) and ``features`` (where φ comes from) are None where the file does not say.
    """

    options: dict[int, SubgoalOption | str]
    max_options: int
    n_primitive: int
    observations: str | None
    features: str | None
    digest: str


def contents_of(path: Path) -> Contents:
    """Read a run folder, an options file or a ``model.zip``; nothing is unpickled."""
    file = option_file.opened(path / NAME if path.is_dir() else path)
    space, features = (file.made_for.space, file.made_for.features) if file.made_for else (None, None)
    options: dict[int, SubgoalOption | str] = {**file.hand_made, **file.options()}
    return Contents(dict(sorted(options.items())), file.max_options, file.n_primitive, space, features, file.digest)


def subgoal_of(option: SubgoalOption, features: str | None) -> str:
    """Its subgoal for people."""
    if not len(option.subgoal.points):
        return "none"
    return described(option.subgoal.points[0], features, option.subgoal.group)


def option_rows(contents: Contents, found: Mapping[int, int] | None = None) -> list[list[str]]:
    """A row of `HEADINGS` for every option; ``found`` has the primitive steps of discovery by slot, if known."""
    rows = []
    for slot, option in contents.options.items():
        when = "" if found is None else f"{found[slot]:,}" if slot in found else "given at the start"
        if isinstance(option, str):
            rows.append([str(slot), option, "by hand: code, not in the file", when, "", "", ""])
            continue
        policy = option.option_policy
        kind = f"table of {len(policy.states):,} states" if isinstance(policy, TabularPolicy) else "network"
        rows.append(
            [
                str(slot),
                option.name,
                subgoal_of(option, contents.features),
                when,
                f"{len(option.initiation_set.points):,}",
                f"{kind} on the {'observation' if option.policy_input == 'observation' else 'features'}",
                f"{option.max_duration:,} steps",
            ]
        )
    return rows


def show_options(config: InspectConfig, console: Console) -> None:
    """Print and draw the contents of an options file."""
    contents = contents_of(config.file)
    console.print(_table(HEADINGS, option_rows(contents)))
    console.print(
        f"{len(contents.options)} of {contents.max_options} slots are taken; policies choose among "
        f"{contents.n_primitive} primitive actions."
    )
    console.print(f"Made for observations {escape(contents.observations or 'of an unknown space')}.")
    console.print(f"SHA-256 {contents.digest}")
    if config.out is not None:
        titles = {s: subgoal_of(o, contents.features) for s, o in contents.options.items() if not isinstance(o, str)}
        save_picture(options_picture(contents.options, titles, contents.features), config.out)
        console.print(f"Picture: {escape(str(config.out))}")


def closing_report(console: Console, trained: Trained, other: Trained | None, *, draws: bool) -> None:
    """Print what training found and how it went, and what follows; ``other`` is the run of ``--compare``."""
    config = trained.config
    unit = "episodes" if config.discovery.segmentation == "episodes" else "segments"
    steps = f"{trained.discovery.num_timesteps:,} primitive steps, {trained.discovery.episodes:,} {unit}"
    console.print(f"\n[bold]{'Finished' if trained.finished else 'Interrupted'}[/] after {steps}.")
    contents = contents_of(trained.folder)
    if contents.options:
        console.print("Options:")
        console.print(_table(HEADINGS, option_rows(contents, trained.found)))
    elif trained.discovery.max_new_options == 0:  # else the callback has said why
        console.print(escape(str(trained.discovery.why_nothing())))
    both = other is not None and other.finished
    columns = {"this run": trained} | ({"--no-discover": other} if other is not None and both else {})
    console.print(_table(["", *columns], measures(columns)))
    if both:
        console.print("Both trained for as many primitive steps on the same seed. That is one seed, and no study.")
    elif other is not None:
        steps = f"{other.discovery.num_timesteps:,} of {config.n_timesteps:,} primitive steps"
        console.print(f"The run without discovery was interrupted after {steps}.")
    elif trained.discovery.max_new_options != 0 and not config.compare:
        console.print("Against --no-discover: train with --compare, which trains once more without discovery.")
    _next_commands(console, trained, draws=draws)
    last = other or trained
    goes_on = not last.finished and any(CheckpointFolder(last.folder / runs.CHECKPOINTS))
    if goes_on:
        console.print(f"Resume:       {escape(_resume(last.config, last.folder))}")
    if config.compare and config.discover and not both:
        _how_to_compare(console, trained, last.folder if other is not None and goes_on else None)


def measures(columns: Mapping[str, Trained]) -> list[list[str]]:
    """How training went, exploration included: a row for each measure, a cell for each run.

    A run has learned at the first of two log entries in a row that reach the goal, as in ``compare``.
    """
    histories = [each.discovery.history for each in columns.values()]
    rows = []
    for length, which in ((LAST, f"last {LAST} episodes"), (0, "all episodes")):
        rows.append([f"return, {which}", *(_mean([e.total_reward for e in h[-length:]]) for h in histories)])
        rows.append([f"success rate, {which}", *(_mean([e.success for e in h[-length:]]) for h in histories)])
        rows.append([f"primitive steps, {which}", *(_mean([e.steps for e in h[-length:]]) for h in histories)])
    rows.append(["episodes", *(f"{len(history):,}" for history in histories)])
    try:
        groups: dict[str, Sequence[Run]] = {name: [read_run(each.folder)] for name, each in columns.items()}
        source = source_of([run for (run,) in groups.values()], "auto")
    except (ValueError, OSError):  # nothing was logged
        return rows
    goal, _ = goal_of(None, groups, source)
    after = [learned_after(run.curves[source].get(goal.measure), goal) for (run,) in groups.values()]
    rows.append([f"{goal} after", *("–" if each is None else f"{each:,.0f} steps" for each in after)])
    return rows


def _mean(values: Sequence[float]) -> str:
    return f"{np.mean(values):,.4g}" if values else "–"


def _table(headings: Iterable[str], rows: Iterable[Sequence[str]]) -> Table:
    table = Table(*headings)
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def _markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _next_commands(console: Console, trained: Trained, *, draws: bool) -> None:
    folder = trained.folder
    path = shlex.quote(str(folder))
    video = f" --video {shlex.quote(f'{folder}/video.mp4')}" if draws else ""
    lines = [
        f"Run folder:   {folder}",
        f"TensorBoard:  {python()} -m tensorboard.main --logdir {path}",
        f"Evaluate:     {command()} evaluate {path}{video}{_importing(trained.config)}",
    ]
    console.print(*map(escape, lines), sep="\n")


def _how_to_compare(console: Console, trained: Trained, other: Path | None) -> None:
    """Print how to set the run without discovery beside the run; ``other`` can be resumed, None is to be trained."""
    run = quoted(trained.folder)
    beside = quoted(other or Path("FOLDER"))
    if other is None:
        options = "" if runs.options_of(trained.folder) is None else " --options None"
        words = f"--config {run} --no-discover --no-compare{options}{_importing(trained.config)}"
        console.print(f"No discovery: {escape(f'{command()} {words}')}")
        beside += "  # the run folder that the line above names when it ends"
    console.print(f"Then compare: {escape(f'{command()} compare {run} {beside}')}")


def how_to_resume(config: TrainConfig, folder: Path) -> str:
    """The command that goes on from a run's last checkpoint; empty where there is none."""
    if not any(CheckpointFolder(folder / runs.CHECKPOINTS)):
        return ""
    return f"Go on from its last checkpoint: {_resume(config, folder)}"


def _resume(config: TrainConfig, folder: Path) -> str:
    return f"{command()} resume {quoted(folder)}{_importing(config)}"


def _importing(config: TrainConfig) -> str:
    """The flags that import a module, which are named anew: the file of a run is not trusted with it."""
    return "".join(f" {flag(n)} {shlex.quote(t)}" for n, t in importing(vars(config)).items())


def write_card(trained: Trained) -> None:
    """Write the card into the run folder, whose model and options are saved already."""
    with atomic_write(trained.folder / CARD) as temporary:
        temporary.write_text(_card(trained), encoding="utf-8")


def _card(trained: Trained) -> str:
    config = trained.config
    contents = contents_of(trained.folder)
    rows = option_rows(contents, trained.found)
    parts = [
        "---\nlibrary_name: stable-baselines3\ntags:\n- reinforcement-learning\n- options\n- sb3-options\n---",
        f"# {ALGORITHMS[config.algo][1]} on {config.env}, with options",
        f"An agent of Stable-Baselines3 that also chooses options. Its budget was {config.n_timesteps:,} primitive "
        f"steps, its seed {config.seed}: one run, and no study.",
        "## Options",
        _markdown(HEADINGS, rows) if rows else "None was discovered.",
        *([f"![Subgoals, and what was seen]({runs.SUBGOALS})"] if (trained.folder / runs.SUBGOALS).is_file() else []),
        "## Training episodes, exploration included",
        _markdown(["", "this run"], measures({"this run": trained})),
        "## Use",
        f"```python\n{_program(config)}\n```",
        f"`{runs.MODEL}` is unpickled by Stable-Baselines3. `{runs.OPTIONS}` holds the options alone, as arrays and "
        "JSON, for another agent: `train.py --options` or `OptionsWrapper(env, options_file=...)`.",
        "## Settings",
        f"Other than the defaults; `{runs.CONFIG}` has all of them.",
        f"```yaml\n{yaml_file.dump(_changed(config), sort_keys=False)}```",
        _markdown(["package", "version"], [["Python", platform.python_version()], *_versions()]),
        f"SHA-256 of `{runs.OPTIONS}`: `{contents.digest}`",
    ]
    return "\n\n".join(parts) + "\n"


def _program(config: TrainConfig) -> str:
    """How to load the model with its options."""
    module, name = ALGORITHMS[config.algo]
    imports = ["import gymnasium as gym", f"from {module} import {name}", "", "import sb3_options.envs"]
    imports.append("from sb3_options import OptionsWrapper, load_model")
    kwargs = "".join(f", {key}={value!r}" for key, value in config.env_kwargs.items())
    lines = [f"env = gym.make({config.env!r}{kwargs})"]
    arguments = f"env, max_options={config.max_options}, gamma={config.gamma}"
    if config.env_wrapper is None and is_minigrid(config.env):
        imports.append("from sb3_options.envs.minigrid import make")
        lines = [f"env = make({config.env!r}{kwargs})"]
    for name_of, text in (("env_wrapper", config.env_wrapper), ("feature_map", config.feature_map)):
        user_module, colon, user_name = (text or "").partition(":")
        if colon:
            imports.append(f"from {user_module} import {user_name}")
        if colon and name_of == "env_wrapper":
            lines.append(f"env = {user_name}(env)")
        elif text is not None:
            arguments += f", feature_map={user_name if colon else repr(text)}"
    load = f'model = load_model({name}, "{runs.MODEL}", OptionsWrapper({arguments}))'
    return "\n".join([*imports, "", *lines, load])


def _changed(config: TrainConfig) -> dict[str, Any]:
    """Settings that differ from the defaults of environment and algorithm."""
    usual = configs.as_values(configs.configure(env=config.env, algo=config.algo))
    changed: dict[str, Any] = {}
    for name, value in configs.as_values(config).items():
        if name in (*GROUPS, "algo_kwargs"):
            value = {key: one for key, one in value.items() if one != usual[name].get(key)}
        if value not in (usual[name], {}) and name not in HOW_IT_RAN | {"algo", "env", "seed"}:
            changed[name] = value
    return changed


def _versions() -> list[list[str]]:
    found = []
    for package in PACKAGES:
        try:
            found.append([package, version(package)])
        except PackageNotFoundError:
            continue
    return found
