"""What a search for settings varies: a YAML file, read and checked before anything trains."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from sb3_options.runs import config as configs
from sb3_options.runs import yaml_file
from sb3_options.runs.algorithms import check_algorithm
from sb3_options.runs.config import GROUPS, TrainConfig
from sb3_options.runs.users_code import IMPORTING, named_in_errors, with_trusted

Value: TypeAlias = Any
"""Of a setting: a number, text, truth value or list."""

PARTS = ("base", "search")
RANGE = ("low", "high", "log", "step")
FIXED = ("algo", "seed", "tensorboard_log", "compare", "progress")
"""What cannot be searched: a search has one algorithm, and seeds and folders of its own."""


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``, both included.

    Attributes:
        low: The lowest; an int makes the setting one.
        high: The highest.
        log: Whether drawn uniformly in the logarithm.
        step: Between neighbouring values; None for any.
    """

    low: float
    high: float
    log: bool = False
    step: float | None = None

    @property
    def whole(self) -> bool:
        """Whether integers are drawn."""
        return isinstance(self.low, int) and isinstance(self.high, int)


@dataclass(frozen=True)
class Choices:
    """A few values, which have no order.

    Attributes:
        values: At least two.
    """

    values: tuple[Value, ...]

    @property
    def names(self) -> list[str]:
        """What Optuna stores of them: lists have no hash."""
        return [json.dumps(value) for value in self.values]


class SearchSpace(NamedTuple):
    """Settings that stay and settings that vary.

    Attributes:
        where: The file, for errors.
        base: Settings of ``train.py`` that all runs share.
        search: Ranges and choices by the name of the setting; ``discovery.decay`` is one of a group.
    """

    where: Path
    base: dict[str, Any]
    search: dict[str, Range | Choices]

    def config(self, proposed: Mapping[str, Value], seed: int, folder: Path) -> TrainConfig:
        """The configuration of a run.

        Args:
            proposed: Values by the names of `search`.
            seed: Of the run.
            folder: For its run folder.

        Raises:
            ValueError: The settings do not go together.
        """
        values: dict[str, Any] = {**self.base, "seed": seed, "tensorboard_log": str(folder)}
        for name, value in proposed.items():
            group, dot, rest = name.partition(".")
            if dot:
                values[group] = {**values.get(group, {}), rest: value}
            else:
                values[name] = value
        return configs.made(values, self.where)

    @property
    def digest(self) -> str:
        """Tells two searches apart."""
        content = {"base": self.base, "search": {name: repr(of) for name, of in self.search.items()}}
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


def read_space(path: Path, trusted: Mapping[str, str | None]) -> SearchSpace:
    """A file with ``base`` and ``search``.

    Args:
        path: Of the file.
        trusted: What the user has named on the command line and may import modules.

    Raises:
        OSError: The file cannot be read.
        ModuleNotFoundError: The algorithm is one of sb3-contrib's, which is not installed.
        ValueError: It describes no search, or names what would import a module.
    """
    with named_in_errors("tune", path):
        content = yaml_file.read_mapping(path)
    if unknown := [name for name in content if name not in PARTS]:
        raise ValueError(f"{path}: there is no part {unknown[0]!r}: write `base:` (settings) and `search:` (ranges).")
    base, search = ({str(k).replace("-", "_"): v for k, v in _part(content, part, path).items()} for part in PARTS)
    if not search:
        raise ValueError(f"{path}: `search:` names nothing. Say what is to be varied: `learning_rate: [0.001, 0.01]`.")
    base = dict(configs.with_method(with_trusted(base, trusted, path), path))
    base.setdefault("algo", configs.default_algo(str(base.get("env", TrainConfig.env))))
    for name in search:
        first, _, inner = name.partition(".")
        of = [f.name for f in dataclasses.fields(GROUPS[first])] if inner and first in GROUPS else ["method"]
        if (inner or first) not in (*of, *configs.names_of(str(base["algo"]))):
            configs.made({**base, name: None}, path)  # which says what it may mean
    space = SearchSpace(path, base, {name: _dimension(path, name, of) for name, of in search.items()})
    for name in space.search:
        if name in FIXED or name in IMPORTING or name in GROUPS or name == "method":
            raise ValueError(f"{path}: {name} cannot be varied. Search apart, or name a setting within it.")
    for last in (False, True):  # names and both ends are right
        check_algorithm(space.config({name: _end(of, last=last) for name, of in space.search.items()}, 0, Path("runs")))
    return space


def _part(content: Mapping[str, Any], name: str, path: Path) -> dict[str, Any]:
    part = content.get(name) or {}
    if not isinstance(part, dict):
        raise ValueError(f"{path}: `{name}:` must hold `name: value` lines, got a {type(part).__name__}.")
    return part


def _dimension(path: Path, name: str, of: Any) -> Range | Choices:
    if isinstance(of, list):
        if len(of) < 2:
            raise ValueError(f"{path}: {name} has {len(of)} value to choose from; two are the fewest.")
        return Choices(tuple(of))
    example = "{low: 0.0001, high: 0.01, log: true} or a list of values"
    if not isinstance(of, dict) or not {"low", "high"} <= set(of) <= set(RANGE):
        raise ValueError(f"{path}: {name} takes {example}, got {of!r}.")
    found = Range(**of)
    numbers = [n for n in (found.low, found.high, found.step) if n is not None]
    if not all(isinstance(n, int | float) and not isinstance(n, bool) and math.isfinite(n) for n in numbers):
        raise ValueError(f"{path}: {name} takes {example}, got {of!r}.")
    if not isinstance(found.log, bool) or found.low >= found.high or (found.log and found.low <= 0):
        raise ValueError(f"{path}: {name} needs low < high, and low > 0 where log is true, got {of!r}.")
    if found.step is not None and (found.log or found.step <= 0):
        raise ValueError(f"{path}: {name} takes a step > 0, and none where log is true, got {of!r}.")
    return found


def _end(of: Range | Choices, *, last: bool) -> Value:
    if isinstance(of, Choices):
        return of.values[-1 if last else 0]
    return of.high if last else of.low
