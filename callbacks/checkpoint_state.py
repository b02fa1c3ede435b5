"""State of callbacks for checkpoints: our callbacks report their own, SB3's is listed here."""

import dataclasses
import itertools
from typing import Any

from stable_baselines3.common import callbacks as sb3
from stable_baselines3.common.callbacks import BaseCallback

from sb3_options.callbacks.tree import all_callbacks
from sb3_options.checkpoints.tree import State
from sb3_options.state import own_state, set_own_state

KNOWN: dict[type[BaseCallback], tuple[str, ...]] = {
    sb3.CheckpointCallback: (),
    sb3.ConvertCallback: (),
    sb3.EvalCallback: (
        "best_mean_reward",
        "last_mean_reward",
        "evaluations_results",
        "evaluations_timesteps",
        "evaluations_length",
        "evaluations_successes",
        "_is_success_buffer",
    ),
    sb3.EveryNTimesteps: ("last_time_trigger",),
    sb3.StopTrainingOnMaxEpisodes: ("n_episodes",),
    sb3.StopTrainingOnNoModelImprovement: ("last_best_mean_reward", "no_improvement_evals"),
    sb3.StopTrainingOnRewardThreshold: (),
}
"""Attributes that SB3's callbacks remember besides their counters. A subclass may remember more."""

COUNTERS = ("n_calls", "num_timesteps")
SETTINGS = ("settings", "option_settings", "embedding")  # attributes of `SubgoalDiscoveryCallback`


def get_states(root: BaseCallback | None) -> list[State]:
    """Return the state of every callback in a tree, in order, without progress bars."""
    return [
        {
            "class": type(each).__name__,
            "known": {name: getattr(each, name) for name in _names(each)},
            "settings": _settings(each),
            "own": own_state(each) if _tells(each) else None,
        }
        for each in _callbacks(root)
    ]


def check(root: BaseCallback | None) -> None:
    """Refuse callbacks that do not tell what they remember."""
    for each in _callbacks(root):
        _names(each)


def set_states(root: BaseCallback | None, states: list[State]) -> None:
    """Restore the states from `get_states` in callbacks that were made with the same settings."""
    callbacks = _callbacks(root)
    written = [{"callback": state["class"], **state["settings"]} for state in states]
    present = [{"callback": type(each).__name__, **_settings(each)} for each in callbacks]
    for then, now in itertools.zip_longest(written, present, fillvalue={"callback": None}):
        for name, value in then.items():
            if now.get(name) != value:
                raise ValueError(
                    f"The checkpoint was written with {name} {value!r}, the present one is {now.get(name)!r}: training "
                    "goes on with the same callbacks and settings alone."
                )
    for callback, state in zip(callbacks, states, strict=True):
        for name in _names(callback):  # a foreign file may name others, as a path to write to
            setattr(callback, name, state["known"][name])
        if _tells(callback):
            set_own_state(callback, state["own"])


def _settings(callback: Any) -> State:
    """Return the settings of `SubgoalDiscoveryCallback`, and the class and numbers of a method of ours."""
    if not hasattr(callback, "discoveries"):
        return {}
    parts = {name: dataclasses.asdict(getattr(callback, name)) for name in SETTINGS}
    method = callback.method
    numbers = vars(method).items() if type(method).__module__.startswith("sb3_options.") else ()
    parts["method"] = {"class": type(method).__name__, **{k: v for k, v in numbers if isinstance(v, int | float)}}
    return {f"{part} {name}": value for part, of in parts.items() for name, value in of.items() if name[0] != "_"}


def _callbacks(root: BaseCallback | None) -> list[BaseCallback]:
    # SB3 puts a progress bar into a list of its own, and not every training has one.
    passed_over = (sb3.ProgressBarCallback, sb3.CallbackList)
    return [each for each in all_callbacks(root) if not isinstance(each, passed_over)]


def _tells(callback: Any) -> bool:
    return hasattr(callback, "STATE") or (hasattr(callback, "get_state") and hasattr(callback, "set_state"))


def _names(callback: BaseCallback) -> tuple[str, ...]:
    """Return the attributes to save: SB3's counters, and those in `KNOWN`."""
    names = next((names for cls, names in KNOWN.items() if isinstance(callback, cls)), ())
    stock = type(callback).__module__.startswith(("stable_baselines3", "sb3_contrib"))
    known = stock and isinstance(callback, tuple(KNOWN))
    own = set(vars(callback)) - set(vars(sb3.ConvertCallback(None))) - {"model", "training_env"}
    if known or _tells(callback) or getattr(callback, "remembers_nothing", False) or not own:
        return COUNTERS + names
    raise ValueError(
        f"Checkpoints of {type(callback).__name__} are not supported yet: give the callback get_state() and "
        "set_state(state), or the attribute remembers_nothing = True if it remembers nothing from step to step."
    )
