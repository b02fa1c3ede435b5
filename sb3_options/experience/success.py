"""Which trajectories succeeded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, MutableMapping, MutableSequence, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sb3_options.checked import is_number
from sb3_options.experience.trajectories import Trajectory

SuccessRule: TypeAlias = Callable[[Trajectory], bool]
"""Whether a trajectory succeeded, so that its bag is positive."""


def success_in(info: Mapping[str, Any]) -> bool | None:
    """What ``is_success`` of the info that ends an episode says: a truth value, or 0 or 1 of any type; None without.

    Anything else is refused, because it might count as success by being something: NaN, "no".
    """
    said = info.get("is_success")
    if said is None:
        return None
    array = np.asarray(said)
    if array.size != 1 or array.dtype.kind not in "biuf" or array.item() not in (0, 1):
        raise ValueError(
            f'info["is_success"] must be True or False (or 1 or 0), got {said!r}: let the environment say which of the '
            "two it means, or leave it out and say what success is by SubgoalDiscoveryCallback(success=...)."
        )
    return bool(array.item())


def reported_success(trajectory: Trajectory) -> bool:
    """What the environment says in ``info["is_success"]``.

    For one that does not say: whether it ended in a terminal state with a positive reward that exceeds all earlier
    ones, the reward peak of Iba (1989) that McGovern & Barto (2001, §2) take over.
    """
    if trajectory.is_success is not None:
        return trajectory.is_success
    rewards = trajectory.rewards
    if not (trajectory.terminated and len(rewards)):
        return False
    return math.inf > float(rewards[-1]) > float(rewards[:-1].max(initial=0.0))


def judged(rule: SuccessRule, trajectory: Trajectory) -> bool:
    """What a rule says of a trajectory; no truth value is refused, which might count as success by being something."""
    said: object = rule(trajectory)
    if not (said is None or isinstance(said, (bool, np.bool_)) or is_number(said)):
        raise TypeError(f"success must return True or False, got {said!r}.")
    return bool(said)


def success_by_return(threshold: float) -> SuccessRule:
    """Success is an undiscounted return of at least ``threshold``; one that is infinite is an error, and no success."""
    if math.isnan(threshold):
        raise ValueError("threshold must be a number, got nan.")
    return lambda trajectory: threshold <= float(trajectory.rewards.sum()) < math.inf


def success_by_steps(limit: int) -> SuccessRule:
    """Success is reported success within ``limit`` primitive steps (McGovern & Barto 2001, §4)."""
    if limit < 1:
        raise ValueError(f"limit must be at least 1 primitive step, got {limit}.")
    return lambda trajectory: reported_success(trajectory) and len(trajectory) <= limit


def success_rule(given: SuccessRule | str) -> SuccessRule:
    """A rule of success, or the one that a text names, as in a YAML file or on a command line.

    Args:
        given: A function; or "reported" (`reported_success`), "terminated" (every terminal state is a success),
            "return:30" (`success_by_return`), or "steps:500" (`success_by_steps`).

    Raises:
        ValueError: The text names no rule.
    """
    if not isinstance(given, str):
        return given
    name, _, value = given.partition(":")
    try:
        if name == "return":
            return success_by_return(float(value))
        if name == "steps":
            return success_by_steps(int(value))
        return {"reported": reported_success, "terminated": lambda trajectory: trajectory.terminated}[given]
    except (KeyError, ValueError):
        raise ValueError(
            f"success takes 'reported', 'terminated', 'return:NUMBER' or 'steps:NUMBER', for instance return:30, got "
            f"{given!r}; in a script also a function of a Trajectory."
        ) from None


def tell_success(
    info: MutableMapping[str, Any],
    said: bool,
    trajectory: Trajectory,
    rule: SuccessRule,
    logged: MutableSequence[bool] | None,
    before: Iterable[bool],
    *,
    reported: bool = False,
) -> None:
    """Put success by a rule into the info that ends an episode, where Stable-Baselines3 logs it from.

    The environment may report another success than the rule, or report it in those episodes alone that succeed. Where
    it never reports any, and the rule is to go by that, there is none to log.

    ``logged`` are the successes that Stable-Baselines3 takes the mean of, and gets those ``before`` the first that was
    reported. ``reported`` says whether the environment has reported success elsewhere.
    """
    if logged is None or (rule is reported_success and trajectory.is_success is None and not (logged or reported)):
        return
    if not logged:
        logged.extend(before)
    info["is_success"] = said


def learned_at(reached: Sequence[bool] | npt.NDArray[np.bool_]) -> int | None:
    """When a task counts as learned: index of the first of two evaluations in a row that reach the goal, or None."""
    entries = np.asarray(reached, dtype=bool)
    first = np.flatnonzero(entries[:-1] & entries[1:])
    return int(first[0]) if len(first) else None
