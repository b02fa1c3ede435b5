"""The command line: train a run, resume it, evaluate it, compare runs, search settings, show options.

What a command runs is imported when it runs, so the help is shown at once.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.extras import how_to_install
from sb3_options.runs import config as configs
from sb3_options.runs.commands import CompareConfig, DemoConfig, EvaluateConfig, InspectConfig, ResumeConfig, TuneConfig
from sb3_options.runs.config import FIELDS, GROUPS, IMPORTING, TrainConfig, flag, program

USAGE = 2
"""Exit status where the command line makes no sense."""

TRY_AGAIN = 75
"""Exit status where a worker process was killed: ``EX_TEMPFAIL`` of sysexits.h."""

LAST_IN_SHORT_HELP = "tensorboard_log"
"""``--help`` shows the settings as far as this one."""

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
    settings: Any
    try:
        target = "training:train"
        if command in COMMANDS:
            of, target = COMMANDS[command]
            settings = tyro.cli(of, prog=f"{program()} {command}", args=args[1:])
        else:
            settings = parse(args[1:] if command == "train" else args, program())
        status = 1
        module, _, name = target.partition(":")
        run = getattr(importlib.import_module(f"sb3_options.runs.{module}"), name)
        done = run(settings, Console(highlight=False, soft_wrap=True))
    except KeyboardInterrupt as interrupt:
        print(" ".join(["Interrupted", *map(str, interrupt.args)]), file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        raise  # `__main__` ends quietly
    except ModuleNotFoundError as error:
        _stop(error, f"{error}. {how_to_install('tune')}" if error.name in ("optuna", "joblib") else str(error), status)
    except (ValueError, TypeError, OSError, MemoryError, NotImplementedError) as error:
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


def parse(args: Sequence[str], prog: str = "train.py") -> TrainConfig:
    """The configuration that a command line describes: a flag is a line of a file of settings."""
    word, rest = (args[0], args[1:]) if args and not args[0].startswith("-") else (None, args)
    if word is not None:
        configs.check_algo(word.lower())  # a mistyped command is no algorithm
    flags = _flags(["--help" if each == "-h" else each for each in rest])
    if "version" in flags:
        print(f"sb3-options {version('sb3-options')}")
        sys.exit()
    file, section, asked = flags.pop("config", None), flags.pop("help", None), flags.pop("algo", word)
    trusted = {name: flags[name] for name in IMPORTING if name in flags}
    values: dict[str, Any] = {}
    if file is not None:
        values = configs.read(Path(file) / configs.CONFIG if Path(file).is_dir() else Path(file), trusted)
    if asked is not None:
        asked = asked.lower()
        if values.get("algo", asked) != asked:
            values = {name: value for name, value in values.items() if name in FIELDS and name not in configs.OWN}
        values["algo"] = asked
    if section is not None:
        _show_help(configs.build(values | trusted, prog), section, prog)
    if file is not None:
        configs.build(values, file)  # what is wrong with the file is told of the file
    flags |= configs.keywords_of(flags.pop("algo_kwargs", {}))
    return configs.build(values | flags, prog)


def _flags(words: Sequence[str]) -> dict[str, Any]:
    """Settings of a command line by their names: ``--n-steps 64``, ``--no-discover``, ``--net-arch=64``."""
    found: dict[str, list[str]] = {}
    for word in words:
        if word.startswith("--"):
            name, equals, value = word.removeprefix("--").partition("=")
            key = name.replace("-", "_")
            found[key] = [value] if equals else []
        elif not found:
            raise ValueError(f"{word!r} is no flag: one algorithm is trained at a time, and flags begin with --.")
        else:
            found[key].append(word)
    return dict(_value(name, texts) for name, texts in found.items())


def _value(name: str, texts: list[str]) -> tuple[str, Any]:
    """A flag with its value: nothing is a truth value, several are a list."""
    if name in ("env_kwargs", "algo_kwargs"):
        return name, texts
    group, dot, inner = name.rpartition(".")
    switch = inner.removeprefix("no_")
    kind = GROUPS.get(group, TrainConfig).__annotations__.get(switch)
    if not texts:
        if kind != "bool" and name not in ("help", "version"):
            raise ValueError(f"{flag(name)} takes a value, or there is no such flag.")
        return f"{group}{dot}{switch}", "short" if name == "help" else switch == inner
    if texts != ["None"] and (name in ("config", "help") or (kind or "").startswith(("str", "Path"))):
        return name, " ".join(texts)
    values = [configs.value_of(text) for text in texts]
    return name, values if len(values) > 1 or name == "net_arch" else values[0]


def _show_help(default: TrainConfig, section: str, prog: str) -> NoReturn:
    """Print the flags of a section with their defaults, and exit: whole texts for a group, else a line for each."""
    whole = section in GROUPS
    texts = _texts_of(GROUPS[section] if whole else TrainConfig)
    values = vars(getattr(default, section) if whole else default)
    names = [name for name in values if name not in ("algo", *GROUPS)]
    names = names[: names.index(LAST_IN_SHORT_HELP) + 1] if section == "short" else names
    table = Table(box=None, show_header=False, pad_edge=False, expand=True)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, max_width=20)
    table.add_column(no_wrap=not whole, ratio=1)
    for name in names:
        words = f"{section}." * whole + "no-" * (values[name] is True) + name.replace("_", "-")
        value = "" if isinstance(values[name], bool) else str(values[name])
        table.add_row(f"--{words}", escape(value), escape(texts[name] if whole else texts[name].partition(". ")[0]))
    Console(highlight=False).print(f"usage: {prog} [ALGORITHM] [--FLAG VALUE ...]\n\n{escape(INTRODUCTION)}", table)
    sys.exit(0)


def _texts_of(settings: type[Any]) -> dict[str, str]:
    """What the docstring of a class of settings says of each."""
    attributes = inspect.cleandoc(settings.__doc__ or "").partition("Attributes:\n")[2]
    entries = re.split(r"\n(?=    \w)", attributes)
    return {name.strip(): " ".join(text.split()) for name, _, text in (entry.partition(": ") for entry in entries)}
