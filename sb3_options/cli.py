"""The command line: train a run, resume it, evaluate it, compare runs, search settings, show options.

What a command runs is imported when it runs, so the help is shown at once.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import inspect
import io
import re
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.extras import how_to_install
from sb3_options.runs import config as configs
from sb3_options.runs.commands import CompareConfig, DemoConfig, EvaluateConfig, InspectConfig, ResumeConfig, TuneConfig
from sb3_options.runs.config import FIELDS, GROUPS, TrainConfig
from sb3_options.runs.keywords import PAIRS, value_of
from sb3_options.runs.program import program_name
from sb3_options.runs.users_code import IMPORTING, named_in_errors

if TYPE_CHECKING:
    from sb3_options.runs.interrupts import Interrupts

T = TypeVar("T")

USAGE = 2
"""Exit status where the command line makes no sense."""

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""

TRY_AGAIN = 75
"""Exit status where a worker process was killed: ``EX_TEMPFAIL`` of sysexits.h."""

SHORT_HELP = (
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
"""What ``--help`` shows."""

DEFAULT_WIDTH = 20
"""Characters of a default in the help."""

COMMANDS: dict[str, tuple[type[Any], str]] = {
    "demo": (DemoConfig, "demo:show_demo"),
    "evaluate": (EvaluateConfig, "evaluation:show_evaluation"),
    "resume": (ResumeConfig, "training:resume"),
    "compare": (CompareConfig, "compare:show_comparison"),
    "tune": (TuneConfig, "tune:tune"),
    "options": (InspectConfig, "report:show_options"),
}
"""What a command takes, and the module and function in ``sb3_options.runs`` that it calls."""

INTRODUCTION = """Train an agent that discovers its own options, or evaluate one. Or --version.
  [train] ALGORITHM maskableppo (default), ppo, a2c, trpo, recurrentppo, dqn,
                    qrdqn, optiondqn
  demo              shows the gain in two minutes: a picture, a film (--video)
  evaluate RUN      plays a run again; `resume RUN` goes on with one
  compare RUN ...   sets runs side by side; `options RUN` shows its options
  --config FILE     reads settings, flags win over it; `tune FILE` searches them
  --n-steps 64      any argument of SB3's class is a flag, too
  --help all        all settings of a run; --help discovery: how --method NAME
                    finds subgoals; --help option: how options are learned;
                    --help usefulness: how they are judged
"""


def main(args: Sequence[str] | None = None) -> None:
    """Run a command line: a command and its arguments, or an algorithm and flags."""
    args = sys.argv[1:] if args is None else list(args)
    command = args[0] if args else ""
    status = USAGE
    noted: Interrupts | None = None
    try:
        target = "training:train"
        if command in COMMANDS:
            of, target = COMMANDS[command]
            settings = parsed(of, args[1:], f"{program_name()} {command}")
        else:
            settings = parse(args[1:] if command == "train" else args, program_name())
        status = 1
        run = _imported(target)
        if target.startswith("training:"):
            from sb3_options.runs.interrupts import Interrupts  # which imports SB3

            noted = Interrupts()
            run(settings, noted)
        else:
            run(settings, Console(highlight=False, soft_wrap=True))
    except KeyboardInterrupt as interrupt:
        Console(stderr=True, highlight=False).print(" ".join(["Interrupted", *interrupt.args]) + ".")
        sys.exit(INTERRUPTED if noted is None else noted.status)
    except BrokenPipeError:
        raise  # `__main__` ends quietly
    except (ValueError, TypeError, OSError, ModuleNotFoundError) as error:
        _stop(error, str(error), status)
    except Exception as error:
        _stop_on(error)
    if noted is not None and noted.noted:
        sys.exit(noted.status)


def _imported(target: str) -> Any:
    module, _, name = target.partition(":")
    try:
        return getattr(importlib.import_module(f"sb3_options.runs.{module}"), name)
    except ModuleNotFoundError as error:
        if module != "tune":
            raise
        raise ModuleNotFoundError(f"{error}. Searching takes Optuna: {how_to_install('tune')}.") from error


def _stop_on(error: Exception) -> NoReturn:
    """Exit with one line where an error of a library has a known cause; raise any other."""
    import gymnasium as gym

    from sb3_options.execution.workers import WorkerLostError

    if isinstance(error, WorkerLostError):
        _stop(error, error.what, TRY_AGAIN if error.killed else 1)
    if isinstance(error, gym.error.Error | MemoryError | NotImplementedError):
        _stop(error, str(error), 1)
    raise error


def _stop(error: BaseException, text: str, status: int) -> NoReturn:
    notes = getattr(error, "__notes__", ())
    errors = Console(highlight=False, soft_wrap=True, stderr=True)
    errors.print(f"[bold red]Error:[/] {escape(' '.join([text, *notes]).strip())}")
    sys.exit(status)


def parsed(of: type[T], args: Sequence[str], prog: str, **kwargs: Any) -> T:
    """Settings that flags describe, by tyro. Help is printed, errors are raised as `ValueError`."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            settings: T = tyro.cli(of, prog=prog, args=args, **kwargs)
            return settings
    except SystemExit as stopped:
        if not stopped.code:
            raise
    raise ValueError(" ".join(re.sub(r"[─-╿]", " ", said.getvalue()).split()))


def parse(args: Sequence[str], prog: str = "train.py") -> TrainConfig:
    """The configuration that a command line describes."""
    early = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("--algo", "--env", "--env-wrapper", "--feature-map", "--config"):
        early.add_argument(name)
    early.add_argument("-h", "--help", nargs="?", const="short", choices=(*GROUPS, "short", "all"))
    early.add_argument("--version", action="version", version=f"sb3-options {_version()}")
    word, rest = (args[0], args[1:]) if args and not args[0].startswith("-") else (None, args)
    try:
        given, words = early.parse_known_args(rest)
    except argparse.ArgumentError as error:
        raise ValueError(str(error)) from None
    if word is not None and given.algo is not None and word.lower() != given.algo.lower():
        raise ValueError(f"One algorithm is trained at a time: {word} or {given.algo}?")
    trusted = {name: value for name in IMPORTING if (value := getattr(given, name)) is not None}
    values = {} if given.config is None else _read(Path(given.config), trusted)
    values |= trusted
    if (asked := given.algo or word) is not None:
        if values.get("algo", asked.lower()) != asked.lower():
            values = {name: value for name, value in values.items() if name in FIELDS and name not in configs.OWN}
        values["algo"] = asked.lower()
    default = configs.build(values, given.config or prog)
    if given.help is not None:
        _show_help(default, given.help, prog)
    flags = [re.sub("^--method(?==|$)", "--discovery.method", each) for each in words]
    found: Any = parsed(TrainConfig, flags, f"{prog} {default.algo}", default=default, return_unknown_args=True)
    config: TrainConfig = found[0]
    others: list[str] = found[1]
    own = _arguments(others, default.algo)
    if not own and config.algo_kwargs == default.algo_kwargs:
        return config
    more = configs.merged(default.algo_kwargs, config.algo_kwargs)  # --algo-kwargs adds to the defaults
    return configs.build(configs.as_values(config) | {"algo_kwargs": more} | own, prog)


def _arguments(words: Sequence[str], algo: str) -> dict[str, Any]:
    """Flags that `TrainConfig` does not have, as arguments of the algorithm's class."""
    if not words:
        return {}
    from sb3_options.runs.algorithms import arguments_of  # which imports SB3

    known = arguments_of(algo)
    own: dict[str, Any] = {}
    key = ""
    for word in words:
        if word.startswith("--"):
            name, equals, value = word.partition("=")
            key = name.removeprefix("--").replace("-", "_")
            own[key] = [value_of(key, value)] if equals else []
        else:
            own.setdefault(key, []).append(value_of(key, word))
    for key, read in own.items():
        if key not in known or not read:
            raise ValueError(f"{algo}: {configs.unknown(key, known)}")
        own[key] = read if len(read) > 1 or key == "net_arch" else read[0]
    return own


def _read(path: Path, trusted: dict[str, str]) -> dict[str, Any]:
    """The settings of ``--config``: a file, or a run folder that has one."""
    file = path / configs.CONFIG if path.is_dir() else path
    if path.is_dir() and not file.is_file():
        raise FileNotFoundError(f"--config {path} is no run folder: it lacks {configs.CONFIG}.")
    with named_in_errors("--config", file):
        return configs.read(file, trusted)


def _version() -> str:
    try:
        return version("sb3-options")
    except PackageNotFoundError:
        return "that is not installed"


def _show_help(default: TrainConfig, section: str, prog: str) -> NoReturn:
    """Print the flags of a section with their defaults, and exit: whole texts for a group, else a line for each."""
    rows: list[tuple[str, str, str]] = []
    if section not in GROUPS:
        texts = _texts_of(TrainConfig)
        names = SHORT_HELP if section == "short" else [name for name in FIELDS if name not in ("algo", *GROUPS)]
        rows += [_row(name, getattr(default, name), texts[name]) for name in names]
    for group, of in GROUPS.items():
        if section == group:
            part = vars(getattr(default, group))
            rows += [_row(f"{group}.{name}", part[name], text) for name, text in _texts_of(of).items()]
    table = Table(box=None, show_header=False, pad_edge=False, expand=True)
    one_line = section not in GROUPS
    table.add_column(min_width=max(len(name) for name, _, _ in rows), no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=one_line, overflow="ellipsis" if one_line else "fold", ratio=1)
    for name, value, text in rows:
        value = value if len(value) <= DEFAULT_WIDTH else f"{value[: DEFAULT_WIDTH - 1]}…"
        table.add_row(name, escape(value), escape(text if not one_line else text.partition(". ")[0]))
    Console(highlight=False).print(f"usage: {prog} [ALGORITHM] [--FLAG VALUE ...]\n\n{escape(INTRODUCTION)}", table)
    sys.exit(0)


def _row(name: str, value: Any, text: str) -> tuple[str, str, str]:
    if isinstance(value, dict):
        value = " ".join(PAIRS.str_from_instance(value))
    group, dot, inner = name.replace("_", "-").rpartition(".")
    words = f"--{group}{dot}no-{inner}" if value is True else f"--{group}{dot}{inner}"
    return words, "" if isinstance(value, bool) else str(value), text


def _texts_of(settings: type[Any]) -> dict[str, str]:
    """What the docstring of a class of settings says of each."""
    attributes = inspect.cleandoc(settings.__doc__ or "").partition("Attributes:\n")[2]
    entries = re.split(r"\n(?=    \w)", attributes)
    return {name.strip(): " ".join(text.split()) for name, _, text in (entry.partition(": ") for entry in entries)}
