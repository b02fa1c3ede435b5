"""The command line: train a run, resume it, evaluate it, compare runs, search settings, show options.

Each command imports its modules when it runs, so the help is shown at once.
"""

import importlib
import inspect
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import MISSING
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.runs import config as configs
from sb3_options.runs import yaml_file
from sb3_options.runs.commands import CompareConfig, DemoConfig, EvaluateConfig, InspectConfig, ResumeConfig, TuneConfig
from sb3_options.runs.config import FIELDS, GROUPS, IMPORTING, TrainConfig, flag, program

USAGE = 2  # exit status for an invalid command line
TRY_AGAIN = 75  # exit status if a worker process was killed: ``EX_TEMPFAIL`` of sysexits.h
LAST_IN_SHORT_HELP = "tensorboard_log"  # ``--help`` shows the settings up to this one

COMMANDS: dict[str, tuple[type[Any], str]] = {
    "demo": (DemoConfig, "demo:show_demo"),
    "evaluate": (EvaluateConfig, "evaluation:show_evaluation"),
    "resume": (ResumeConfig, "training:resume"),
    "compare": (CompareConfig, "compare:show_comparison"),
    "tune": (TuneConfig, "tune:tune"),
    "options": (InspectConfig, "report:show_options"),
}
"""Settings of each command, and the module and function in ``sb3_options.runs`` that it calls."""

INTRODUCTION = """Train an agent that discovers its own options, or evaluate one. Or --version.
  [train] ALGORITHM maskableppo (default), ppo, a2c, trpo, recurrentppo, dqn,
                    qrdqn, optiondqn
  demo              shows the gain in two minutes
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
    settings: Any
    try:
        if command in COMMANDS:
            settings = parse_command(command, args[1:])
            target = COMMANDS[command][1]
        else:
            settings = parse(args[1:] if command == "train" else args)
            target = "training:train"
        status = 1
        module, _, name = target.partition(":")
        run = getattr(importlib.import_module(f"sb3_options.runs.{module}"), name)
        done = run(settings, Console(highlight=False, soft_wrap=True))
        sys.stdout.flush()
    except KeyboardInterrupt as interrupt:
        print(" ".join(["Interrupted", *map(str, interrupt.args)]), file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # as from `sb3-options options RUN | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes stdout once more when it exits
        return
    except (ValueError, TypeError, OSError, MemoryError, NotImplementedError, ModuleNotFoundError) as error:
        _stop(error, str(error), status)
    except Exception as error:
        from gymnasium.error import Error

        from sb3_options.execution.workers import WorkerLostError

        if isinstance(error, WorkerLostError):
            _stop(error, error.what, TRY_AGAIN if error.killed else 1)
        if not isinstance(error, Error):
            raise
        _stop(error, str(error), 1)
    if number := getattr(done, "signal", None):
        sys.exit(128 + number)


def _stop(error: BaseException, text: str, status: int) -> NoReturn:
    words = " ".join([text, *getattr(error, "__notes__", ())]).strip()
    Console(highlight=False, soft_wrap=True, stderr=True).print(f"[bold red]Error:[/] {escape(words)}")
    sys.exit(status)


def parse(args: Sequence[str]) -> TrainConfig:
    """Return the configuration that a command line describes: a flag is a line of a file of settings."""
    words, flags = _split(args)
    algo = " ".join(words).lower()
    if words:
        configs.check_algo(algo, COMMANDS)  # a mistyped command is not an algorithm
    asked = dict(_value(name, texts, _type_of(name)) for name, texts in flags.items())
    if "version" in asked:
        print(f"sb3-options {version('sb3-options')}")
        sys.exit()
    file = asked.pop("config", None)
    section = asked.pop("help", None)
    algo = str(asked.pop("algo", algo)).lower()
    trusted = {name: asked[name] for name in IMPORTING if name in asked}
    values: dict[str, Any] = {}
    if file is not None:
        values = configs.read(Path(file) / configs.CONFIG if Path(file).is_dir() else Path(file), trusted)
    if algo:
        if values.get("algo", algo) != algo:
            values = {name: value for name, value in values.items() if name in FIELDS and name not in configs.OWN}
        values["algo"] = algo
    if section is not None:
        _show_help(configs.build(values | trusted, program()), section)
    if file is not None:
        configs.build(values, file)  # errors of the file must name the file
    return configs.build(values | asked, program())


def parse_command(command: str, args: Sequence[str]) -> Any:
    """Return the settings of one of the `COMMANDS`; words before the first flag are its first setting."""
    of = COMMANDS[command][0]
    fields = of.__dataclass_fields__
    first = next(name for name, field in fields.items() if not field.kw_only)
    words, flags = _split(args)
    if "help" in flags:
        _show_help_of(command, first)
    if words:
        flags[first] = words
    types = {name: fields[name.removeprefix("no_")].type for name in flags if name.removeprefix("no_") in fields}
    for name in flags.keys() - types.keys():
        raise ValueError(f"{command}: there is no setting {name!r}.{configs.near(name, {n: n for n in fields})}")
    try:
        return of(**dict(_value(name, texts, types[name]) for name, texts in flags.items()))
    except ValueError as error:
        raise ValueError(f"{command}: {str(error).removeprefix(f'{of.__name__}: ')}") from None


def _split(words: Sequence[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Return the words before the first flag, and the texts of each flag: ``--n-steps 64``, ``--net-arch=64``."""
    leading: list[str] = []
    flags: dict[str, list[str]] = {}
    texts = leading
    for word in words:
        if word.startswith("--") or word == "-h":
            name, equals, value = word.removeprefix("--").partition("=")
            texts = [value] if equals else []
            flags["help" if word == "-h" else name.replace("-", "_")] = texts
        else:
            texts.append(word)
    return leading, flags


def _type_of(name: str) -> str:
    """Return the annotation of a setting of `TrainConfig`, or an empty text for an argument of the algorithm."""
    group, _, inner = name.rpartition(".")
    annotations = GROUPS.get(group, TrainConfig).__annotations__
    return str(annotations.get(inner, annotations.get(inner.removeprefix("no_"), "")))


def _value(name: str, texts: list[str], kind: str) -> tuple[str, Any]:
    """Return a flag with its value: no text is a truth value, several are a list."""
    if kind.startswith("dict"):
        return name, _keywords(name, texts)
    group, dot, inner = name.rpartition(".")
    if not texts:
        if kind != "bool" and name not in ("help", "version"):
            raise ValueError(f"{flag(name)} takes a value, or there is no such flag.")
        switch = inner.removeprefix("no_")
        return f"{group}{dot}{switch}", "short" if name == "help" else switch == inner
    if kind.startswith("tuple"):
        return name, texts
    if texts != ["None"] and (name in ("config", "help") or kind.startswith(("str", "Path"))):
        return name, " ".join(texts)
    values = [_read(text) for text in texts]
    return name, values if len(values) > 1 or name == "net_arch" else values[0]


def _keywords(name: str, pairs: Sequence[str]) -> dict[str, Any]:
    """Return pairs ``name:value`` as keyword arguments."""
    keywords = {}
    for pair in pairs:
        key, colon, value = pair.partition(":")
        if not colon:
            raise ValueError(f"{flag(name)} takes pairs name:value, got {pair}.")
        keywords[key] = _read(value)
    return keywords


def _read(text: str) -> Any:
    """Return a value read as YAML, so that 3 is a number; "None" is None."""
    return None if text == "None" else yaml_file.parse(text)


def _show_help(default: TrainConfig, section: str) -> NoReturn:
    """Print the flags of a section with their defaults, and exit: whole texts for a group, else a line for each."""
    grouped = section in GROUPS
    values = dict(vars(getattr(default, section) if grouped else default))
    for name in ("algo", "algo_kwargs", *GROUPS):
        values.pop(name, None)
    if section == "short":
        names = list(values)
        values = {name: values[name] for name in names[: names.index(LAST_IN_SHORT_HELP) + 1]}
    usage = f"usage: {program()} [ALGORITHM] [--FLAG VALUE ...]\n\n{INTRODUCTION}"
    _print_help(usage, GROUPS.get(section, TrainConfig), values, f"{section}." if grouped else "", whole=grouped)


def _show_help_of(command: str, first: str) -> NoReturn:
    """Print the settings of a command, and exit."""
    of = COMMANDS[command][0]
    about = inspect.cleandoc(of.__doc__ or "").partition("\n\nAttributes:")[0]
    usage = f"usage: {program()} {command} {first.upper()} [--FLAG VALUE ...]\n\n{about}\n"
    values = {name: field.default for name, field in of.__dataclass_fields__.items()}
    _print_help(usage, of, values, whole=True)


def _print_help(usage: str, of: type[Any], values: Mapping[str, Any], prefix: str = "", *, whole: bool) -> NoReturn:
    texts = _texts_of(of)
    table = Table(box=None, show_header=False, pad_edge=False, expand=True)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, max_width=20)
    table.add_column(no_wrap=not whole, ratio=1)
    for name, value in values.items():
        words = prefix + "no-" * (value is True) + name.replace("_", "-")
        shown = "" if isinstance(value, bool) or value is MISSING else str(value)
        table.add_row(f"--{words}", escape(shown), escape(texts[name] if whole else texts[name].partition(". ")[0]))
    Console(highlight=False).print(escape(usage), table)
    sys.exit(0)


def _texts_of(settings: type[Any]) -> dict[str, str]:
    """Return the text of each setting from the docstrings of a class and its bases."""
    texts = {}
    for of in settings.__mro__:
        attributes = inspect.cleandoc(of.__doc__ or "").partition("Attributes:\n")[2]
        for entry in re.split(r"\n(?=    \w)", attributes):
            name, _, text = entry.partition(": ")
            texts[name.strip()] = " ".join(text.split())
    return texts
