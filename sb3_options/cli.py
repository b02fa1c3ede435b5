"""The command line: train a run, resume it, evaluate it, compare runs, search settings, show options.

What a command runs is imported when it runs, so the help is shown at once.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
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
from sb3_options.runs.keywords import NUMBERS, PAIRS, value_of
from sb3_options.runs.program import program_name
from sb3_options.runs.users_code import IMPORTING, named_in_errors

if TYPE_CHECKING:
    from sb3_options.runs.evaluation import Evaluation
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

FOREIGN = {"lr": "learning-rate", "timesteps": "n-timesteps", "total-timesteps": "n-timesteps"}
"""Flags of other programs, and what they are called in this one."""

INTRODUCTION = """Train an agent that discovers its own options, or evaluate one. Or --version.
  [train] ALGORITHM maskableppo (default), ppo, a2c, trpo, recurrentppo, dqn,
                    qrdqn, optiondqn
  demo              shows the gain in two minutes: a picture, a film (--video)
  evaluate RUN      plays a run again; `resume RUN` goes on with one
  compare RUN ...   sets runs side by side; `options RUN` shows its options
  --config FILE     reads settings, flags win over it; `tune FILE` searches them
  --n-steps 64      any argument of SB3's class is a flag, too
  --help all        all settings; --help discovery: how --method NAME finds
                    subgoals; --help option: how options are learned;
                    --help usefulness: how they are judged
"""


def main(args: Sequence[str] | None = None) -> None:
    """Run a command line: a command and its arguments, or an algorithm and flags.

    Args:
        args: Without the program's name; by default those of the process.
    """
    args = sys.argv[1:] if args is None else list(args)
    command = args[0] if args else ""
    status = USAGE
    noted: Interrupts | None = None
    try:
        if command in COMMANDS:
            of, run = COMMANDS[command]
            settings = parsed(of, args[1:], f"{program_name()} {command}")
        else:
            run = train
            settings = parse(args[1:] if command == "train" else args, program_name())
        status = 1
        if run in (train, resume):
            from sb3_options.runs.interrupts import Interrupts  # which imports SB3

            noted = Interrupts()
            run = partial(run, interrupts=noted)
        run(settings)
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


def _stop_on(error: Exception) -> NoReturn:
    """Exit with one line where an error of a library has a known cause; raise any other."""
    import gymnasium as gym

    from sb3_options.execution.workers import WorkerLostError
    from sb3_options.runs.budget import memory_is_short

    if isinstance(error, WorkerLostError):
        _stop(error, error.what, TRY_AGAIN if error.killed else 1)
    if isinstance(error, gym.error.Error):
        _stop(error, str(error), 1)
    if isinstance(error, MemoryError | RuntimeError) and (text := memory_is_short(error)) is not None:
        _stop(error, text, 1)
    raise error


def _stop(error: BaseException, text: str, status: int) -> NoReturn:
    notes = getattr(error, "__notes__", ())
    errors = Console(highlight=False, soft_wrap=True, stderr=True)
    errors.print(f"[bold red]Error:[/] {escape(' '.join([text, *notes]).strip())}")
    sys.exit(status)


def parsed(of: type[T], args: Sequence[str], prog: str, default: T | None = None) -> T:
    """Settings that flags describe. Help is printed as tyro has it, errors are raised.

    Raises:
        ValueError: A flag is unknown, or a value is none.
    """
    console_text = io.StringIO()
    given: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(console_text):
            settings: T = tyro.cli(of, prog=prog, args=args, registry=NUMBERS, **given)
            return settings
    except SystemExit as stopped:
        if not stopped.code:
            raise
    raise ValueError(" ".join(re.sub(r"[─-╿]", " ", console_text.getvalue()).split()))


def parse(args: Sequence[str], prog: str = "train.py") -> TrainConfig:
    """The configuration that a command line describes.

    Args:
        args: Without the program's name: the algorithm or nothing, and flags.
        prog: For the help text.

    Returns:
        The configuration: flags over the file of ``--config`` over the defaults of environment and algorithm.

    Raises:
        ValueError: A flag or a setting makes no sense.
        OSError: A file cannot be read.
    """
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
    flags, own = _apart(words, default.algo)
    if own:
        default = configs.build(configs.as_values(default) | own, prog)
    if given.help is not None:
        _show_help(default, given.help, prog)
    config = parsed(TrainConfig, flags, f"{prog} {default.algo}", default)
    if config.algo_kwargs != default.algo_kwargs:  # --algo-kwargs adds to the defaults
        more = configs.merged(default.algo_kwargs, config.algo_kwargs)
        config = configs.build(configs.as_values(config) | {"algo_kwargs": more}, prog)
    return config


def _apart(words: Sequence[str], algo: str) -> tuple[list[str], dict[str, Any]]:
    """Flags of `TrainConfig`, and arguments of the algorithm's class that were given as flags."""
    flags: list[str] = []
    own: dict[str, Any] = {}
    arguments: Mapping[str, Any] | None = None
    i = 0
    while i < len(words):
        name, equals, value = words[i].partition("=")
        values = [value] if equals else []
        i += 1
        while i < len(words) and not words[i].startswith("--") and not equals:
            values.append(words[i])
            i += 1
        key = name.removeprefix("--").replace("-", "_")
        if name == "--method":
            name = "--discovery.method"
        elif key in FOREIGN or key.replace("_", "-") in FOREIGN:
            raise ValueError(f"There is no flag {name}. Did you mean --{FOREIGN[key.replace('_', '-')]}?")
        elif name.startswith("--") and "." not in key and key.removeprefix("no_") not in FIELDS:
            if arguments is None:
                from sb3_options.runs.algorithms import arguments_of  # which imports SB3

                arguments = arguments_of(algo)
            if key in arguments and values:
                read = [value_of(key, each) for each in values]
                own[key] = read if len(read) > 1 or key == "net_arch" else read[0]
                continue
            raise ValueError(f"{algo}: {configs.unknown(key, arguments)}")
        flags += [f"{name}={value}"] if equals else [name, *values]
    return flags, own


def _read(path: Path, trusted: Mapping[str, str]) -> dict[str, Any]:
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
        if section in (group, "all"):
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


def train(config: TrainConfig, interrupts: Interrupts | None = None) -> Path:
    """Train, and leave a run folder; see `runs.training.train`."""
    from sb3_options.runs import training

    return training.train(config, interrupts).folder


def resume(config: ResumeConfig, interrupts: Interrupts | None = None) -> None:
    """Go on with a run that was cut off; see `runs.training.resume`."""
    from sb3_options.runs import training

    training.resume(config, interrupts)


def demo(config: DemoConfig) -> None:
    """Show the gain; see `runs.demo.show_demo`."""
    from sb3_options.runs.demo import show_demo

    show_demo(config, _console())


def evaluate(config: EvaluateConfig) -> Evaluation:
    """Evaluate a run; see `runs.evaluation.show_evaluation`."""
    from sb3_options.runs.evaluation import show_evaluation

    return show_evaluation(config, _console())


def compare(config: CompareConfig) -> None:
    """Set runs side by side; see `runs.compare.show_comparison`."""
    from sb3_options.runs.compare import show_comparison

    show_comparison(config, _console())


def tune(config: TuneConfig) -> None:
    """Search for settings; see `runs.tune.tune`.

    Raises:
        ModuleNotFoundError: Optuna is not installed.
    """
    try:
        from sb3_options.runs import tune as tuning  # Optuna is in an extra
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}. Searching takes Optuna: {how_to_install('tune')}.") from error
    tuning.tune(config, _console())


def options(config: InspectConfig) -> None:
    """Show what is in an options file; see `runs.report.show_options`."""
    from sb3_options.runs.report import show_options

    show_options(config, _console())


def _console() -> Console:
    return Console(highlight=False, soft_wrap=True)


COMMANDS: dict[str, tuple[type[Any], Callable[[Any], object]]] = {
    "demo": (DemoConfig, demo),
    "evaluate": (EvaluateConfig, evaluate),
    "resume": (ResumeConfig, resume),
    "compare": (CompareConfig, compare),
    "tune": (TuneConfig, tune),
    "options": (InspectConfig, options),
}
"""What a command takes, and what it does."""
