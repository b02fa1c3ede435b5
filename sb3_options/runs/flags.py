"""The flags of ``train.py``: from words to a configuration, and the help."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from sb3_options.runs import config as configs
from sb3_options.runs.config import GROUPS, TrainConfig
from sb3_options.runs.users_code import IMPORTING

FIRST = (
    "env",
    "env_kwargs",
    "series",
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
    "close_harmful",
    "min_reached",
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

INTRODUCTION = """Train an agent that discovers its own options, or evaluate one.
  ALGORITHM         maskableppo (default), ppo, a2c, trpo, recurrentppo, dqn,
                    qrdqn, optiondqn. Its settings: `{prog} ppo --help`
  evaluate RUN      plays a run again; `resume RUN` goes on with one
  compare RUN ...   sets runs side by side; `options RUN` shows its options
  --config FILE     reads settings, flags win over it; `tune FILE` searches them
  --help discovery  how --method NAME finds subgoals; --help option; --help all
"""


def parse(args: Sequence[str], prog: str = "train.py") -> TrainConfig:
    """The configuration that a command line describes. Exits with a message where it makes no sense.

    Args:
        args: Without the program's name: the algorithm or nothing, then flags.
        prog: For the help text.

    Returns:
        The configuration: flags over the file of ``--config`` over the defaults of environment and algorithm.
    """
    early = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False)
    for name in ("--algo", "--env", "--env-wrapper", "--feature-map", "--config"):
        early.add_argument(name)
    early.add_argument("-h", "--help", nargs="?", const=True, choices=(*GROUPS, "all"))
    first = [word for word in args[:1] if not word.startswith("-")]
    given, flags = early.parse_known_args(args[len(first) :])
    flags = [f"--{METHOD}{word.removeprefix('--method')}" if SHORT.match(word) else word for word in flags]
    try:
        trusted = {name: value for name in IMPORTING if (value := getattr(given, name)) is not None}
        values = {} if given.config is None else configs.read(Path(given.config), trusted)
        values |= trusted
        # A file that names no algorithm was written for DQN.
        unnamed = configs.default_algo(given.env or TrainConfig.env) if given.config is None else "dqn"
        algo = given.algo or (first or [str(values.get("algo", unnamed))])[0]
        default = configs.made({**values, "algo": algo}, given.config or prog)
        for flag in flags:
            name = flag.removeprefix("--").removeprefix("no-").partition("=")[0].replace("-", "_")
            if flag.startswith("--") and name in configs.HAD_BY_ALL and name not in configs.names_of(algo):
                raise ValueError(configs.no_effect(name, algo))
    except (ValueError, OSError) as error:
        sys.exit(f"{prog}: {error}")
    if given.help is not None:
        _show_help(default, given.help, f"{prog} [ALGORITHM]")
    return tyro.cli(type(default), prog=f"{prog} {algo}", default=default, args=flags)


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
