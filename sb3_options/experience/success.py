"""Rules for which trajectories succeeded."""

import math
from collections.abc import Callable, Iterable, Mapping, MutableMapping, MutableSequence, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sb3_options.checked import is_number
from sb3_options.experience.trajectories import Trajectory

SuccessRule: TypeAlias = Callable[[Trajectory], bool]
"""Function that says whether a trajectory succeeded, so its bag is positive."""


def success_in(info: Mapping[str, Any]) -> bool | None:
    """Return ``is_success`` of the info that ends an episode: True or False, or 0 or 1 of any type; None without it.

    Other values, such as NaN or "no", are refused: Python might count them as true.
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
    """Return the environment's ``info["is_success"]``.

    Without it, success is a terminal state with a positive reward that exceeds all earlier ones. This is the reward
    peak of Iba (1989), which McGovern & Barto (2001, §2) adopt.
    """
    if trajectory.is_success is not None:
        return trajectory.is_success
    rewards = trajectory.rewards
    if not (trajectory.terminated and len(rewards)):
        return False
    return math.inf > float(rewards[-1]) > float(rewards[:-1].max(initial=0.0))


def judged(rule: SuccessRule, trajectory: Trajectory) -> bool:
    """Return a rule's verdict on a trajectory; refuse values other than truth values, which might count as true."""
    said: object = rule(trajectory)
    if not (said is None or isinstance(said, (bool, np.bool_)) or is_number(said)):
        raise TypeError(f"success must return True or False, got {said!r}.")
    return bool(said)


def success_by_steps(limit: int) -> SuccessRule:
    """Define success as reported success within ``limit`` primitive steps (McGovern & Barto 2001, §4)."""
    if limit < 1:
        raise ValueError(f"limit must be at least 1 primitive step, got {limit}.")
    return lambda trajectory: reported_success(trajectory) and len(trajectory) <= limit


def success_rule(given: SuccessRule | str) -> SuccessRule:
    """Return a rule of success, or the rule that a text names, as in a YAML file or on a command line.

    Args:
        given: A function; or "reported" (`reported_success`), "terminated" (every terminal state is a success),
            "return:30" (a finite undiscounted return of at least 30), or "steps:500" (`success_by_steps`).

    Raises:
        ValueError: The text names no rule.
    """
    if not isinstance(given, str):
        return given
    name, _, value = given.partition(":")
    try:
        if name == "return" and not math.isnan(least := float(value)):
            return lambda trajectory: least <= float(trajectory.rewards.sum()) < math.inf
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
    """Put a rule's verdict into the info that ends an episode, from which Stable-Baselines3 logs success.

    The environment may report another success than the rule, or report it only in successful episodes. If the
    environment never reports any, and the rule relies on its reports, there is no success to log.

    ``logged`` are the successes that Stable-Baselines3 averages. Before the first reported one, it gets those
    ``before``. ``reported`` says whether the environment has reported success elsewhere.
    """
    if logged is None or (rule is reported_success and trajectory.is_success is None and not (logged or reported)):
        return
    if not logged:
        logged.extend(before)
    info["is_success"] = said


def learned_at(reached: Sequence[bool] | npt.NDArray[np.bool_]) -> int | None:
    """Return the index of the first of two evaluations in a row that reach the goal; None if it is not learned."""
    entries = np.asarray(reached, dtype=bool)
    first = np.flatnonzero(entries[:-1] & entries[1:])
    return int(first[0]) if len(first) else None
