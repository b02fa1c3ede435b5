"""The flags of ``train.py``: from words to a configuration, and the help."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from sb3_options.runs import config as configs
from sb3_options.runs.config import CLASSES, GROUPS, TrainConfig
from sb3_options.runs.folder import CONFIG
from sb3_options.runs.keywords import NUMBERS, check_keywords
from sb3_options.runs.users_code import IMPORTING, named_in_errors

FIRST = (
    "env",
    "env_kwargs",
    "n_timesteps",
    "seed",
    "n_envs",
    "options",
    "max_options",
    "max_new_options",
    "discover",
    "compare",
    "eval_freq",
    "tensorboard_log",
)
"""What a user changes first, and ``--help`` shows first."""

LAST = (
    "env_wrapper",
    "feature_map",
    "bonus",
    "success",
    "checkpoint_freq",
    "eval_episodes",
    "eval_max_steps",
    "vec_env",
    "device",
    "num_threads",
    "progress",
)
"""What is rarely changed."""

METHOD = "discovery.method"
SHORT = re.compile(r"--method(=|$)")
"""How `METHOD` may be spelt for short."""

SWITCHES = frozenset({"help", "version"}).union(
    *({f.name for f in dataclasses.fields(of) if isinstance(f.default, bool)} for of in CLASSES.values()),
    *({f"{g}.{f.name}" for f in dataclasses.fields(of) if isinstance(f.default, bool)} for g, of in GROUPS.items()),
)
"""Flags that take no value."""

ELSEWHERE = {"lr": "learning-rate", "timesteps": "n-timesteps", "total-timesteps": "n-timesteps"}
"""What others call a flag, and what it is called here."""

INTRODUCTION = """Train an agent that discovers its own options, or evaluate one. Or --version.
  [train] ALGORITHM maskableppo (default), ppo, a2c, trpo, recurrentppo, dqn,
                    qrdqn, optiondqn. Its settings: `{prog} ppo --help`
  evaluate RUN      plays a run again; `resume RUN` goes on with one
  compare RUN ...   sets runs side by side; `options RUN` shows its options
  --config FILE     reads settings, flags win over it; `tune FILE` searches them
  --help discovery  how --method NAME finds subgoals; --help option; --help all
"""


def parse(args: Sequence[str], prog: str = "train.py") -> TrainConfig:
    """The configuration that a command line describes. Exits with a message where it makes no sense.

    Args:
        args: Without the program's name: flags, and the algorithm or nothing.
        prog: For the help text.

    Returns:
        The configuration: flags over the file of ``--config`` over the defaults of environment and algorithm.

    Raises:
        ValueError: The environment has no such keyword argument.
    """
    early = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False)
    for name in ("--algo", "--env", "--env-wrapper", "--feature-map", "--config"):
        early.add_argument(name)
    early.add_argument("-h", "--help", nargs="?", const=True, choices=(*GROUPS, "all"))
    early.add_argument("--version", action="version", version=f"sb3-options {_version()}")
    named, words = _algorithms_apart(args)
    given, flags = early.parse_known_args(words)
    flags = [f"--{METHOD}{word.removeprefix('--method')}" if SHORT.match(word) else word for word in flags]
    try:
        if len(set(named)) > 1:
            raise ValueError(f"One algorithm is trained at a time: {' or '.join(named)}?")
        trusted = {name: value for name in IMPORTING if (value := getattr(given, name)) is not None}
        values = {} if given.config is None else _read(Path(given.config), trusted)
        values |= trusted
        unnamed = configs.default_algo(str(values.get("env", TrainConfig.env)))
        algo = (given.algo or (named or [str(values.get("algo", unnamed))])[0]).lower()
        names = [_name_of(flag) for flag in flags if flag.startswith("--")]
        if values.get("algo", algo) != algo:  # what is the algorithm's own says nothing of another
            values = {name: value for name, value in values.items() if name in (*configs.FOR_ANOTHER, "method")}
        default = configs.made({**values, "algo": algo}, given.config or prog)
        for name in names:
            if (spelt := name.replace("_", "-")) in ELSEWHERE:
                raise ValueError(f"There is no flag --{spelt}. Did you mean --{ELSEWHERE[spelt]}?")
            if name in configs.OF_ALL and name not in configs.names_of(algo):
                raise ValueError(configs.no_effect(name, algo))
    except (ValueError, OSError) as error:
        sys.exit(f"{prog}: {error}")
    if given.help is not None:
        _show_help(default, given.help, f"{prog} [ALGORITHM]")
    config = tyro.cli(type(default), prog=f"{prog} {algo}", default=default, args=flags, registry=NUMBERS)
    check_keywords(config.env, config.env_kwargs, wrapper=config.env_wrapper)
    return config


def _read(path: Path, trusted: Mapping[str, str]) -> dict[str, Any]:
    """The settings of ``--config``: a file, or a run folder that has one.

    Raises:
        OSError: It cannot be read.
        ValueError: It holds no settings.
    """
    file = path / CONFIG if path.is_dir() else path
    if path.is_dir() and not file.is_file():
        raise FileNotFoundError(f"--config {path} is no run folder: it lacks {CONFIG}. Name a file, or a run folder.")
    with named_in_errors("--config", file):
        return configs.read(file, trusted)


def _version() -> str:
    """Of the library, as it was installed."""
    try:
        return version("sb3-options")
    except PackageNotFoundError:
        return "that is not installed"


def _name_of(flag: str) -> str:
    """The setting that a flag is of, or switches off."""
    return flag.removeprefix("--").removeprefix("no-").partition("=")[0].replace("-", "_").replace(".no_", ".")


def _algorithms_apart(args: Sequence[str]) -> tuple[list[str], list[str]]:
    """Set the algorithm apart, wherever it stands: the words that name one, and the others.

    A word behind a flag that takes a value is that value. No flag that takes several values takes an algorithm.
    """

    def is_value(i: int) -> bool:
        flag = args[i - 1] if i else ""
        return flag.startswith("--") and "=" not in flag and _name_of(flag) not in SWITCHES

    at = {i for i, word in enumerate(args) if word.lower() in CLASSES and not is_value(i)}
    at |= {i for i, word in enumerate(args[:1]) if not word.startswith("-")}
    return [args[i].lower() for i in sorted(at)], [word for i, word in enumerate(args) if i not in at]


def _show_help(default: TrainConfig, section: str | bool, prog: str) -> None:
    """Print the flags of a section with their defaults, under headings, and exit."""
    of = type(default)
    types = get_type_hints(of, include_extras=True)
    entries = "\n".join(inspect.cleandoc(each.__doc__ or "").partition("Attributes:\n")[2] for each in of.__mro__)

    def view(text: str, names: Sequence[str], **groups: Any) -> Any:
        """A class that has only these fields."""
        values = {name: getattr(default, name) for name in names} | groups
        shown: dict[str, Any] = {name: Annotated[types[name], tyro.conf.arg(prefix_name=False)] for name in names}
        shown |= {name: type(group) for name, group in groups.items()}
        fields = [(name, shown[name], dataclasses.field(default_factory=partial(values.get, name))) for name in values]
        return dataclasses.make_dataclass("View", fields, namespace={"__doc__": f"{text}\n\nAttributes:\n{entries}"})

    groups = {name: getattr(default, name) for name in GROUPS if section in (name, "all")}
    if section not in GROUPS:
        names = [f.name for f in dataclasses.fields(of) if f.name not in (*FIRST, *LAST, *GROUPS, "algo")]
        rest = {"learning": view("", names)(), "other": view("", LAST)()}
        groups = rest | groups
    everything = view("", () if section in GROUPS else FIRST, **groups)
    tyro.cli(everything, prog=prog, description=INTRODUCTION.format(prog=prog.partition(" [")[0]), args=["--help"])
