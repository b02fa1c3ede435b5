"""The state of an environment in mid-episode: of each of its wrappers and of the innermost environment.

An environment that supports this has ``get_state()`` and ``set_state(state)``. Its state consists of numbers, text,
arrays, lists and dictionaries, and need not include ``np_random``. For other environments, and for wrappers with an
unknown state, the episode is repeated; see `repeating`.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import wrappers
from gymnasium.wrappers.utils import RunningMeanStd
from stable_baselines3.common.monitor import Monitor

from sb3_options.execution.repeating import RecordActions, random_states, set_random_states
from sb3_options.state import FOREIGN, declare, own_state, set_own_state

State = dict[str, Any]

MONITOR_LISTS = ("rewards", "episode_returns", "episode_lengths", "episode_times")  # its attributes that are lists

declare(wrappers.TimeLimit, "_elapsed_steps")
declare(wrappers.OrderEnforcing, "_has_reset")
declare(wrappers.Autoreset, "autoreset")
declare(wrappers.NormalizeObservation, "obs_rms")
declare(wrappers.NormalizeReward, "return_rms", "discounted_reward")
declare(RunningMeanStd, "mean", "var", "count")

REMEMBER_NOTHING = (  # wrappers, with their subclasses, that are the same in every step
    wrappers.PassiveEnvChecker,  # it checks the first step once more
    wrappers.TransformAction,
    wrappers.TransformObservation,
    wrappers.TransformReward,
)


def prepare(env: Any, *, just_reset: bool = False) -> Any:
    """Return the environment, with a `RecordActions` around the outermost layer of unknown state."""
    layers = list(_layers(env))
    silent = next((i for i, layer in enumerate(layers) if isinstance(layer, RecordActions) or not _tells(layer)), None)
    if silent is None or isinstance(layers[silent], RecordActions):
        return env
    if any(hasattr(layer, "on_layers") for layer in layers[silent:]):  # OptionsWrapper has it
        raise ValueError(
            f"Checkpoints of {type(layers[silent]).__name__} are not supported above OptionsWrapper: put the wrapper "
            "beneath it, give it get_state() and set_state(state), or the attribute remembers_nothing = True if it is "
            "the same in every step."
        )
    recorder = RecordActions(layers[silent], just_reset=just_reset)
    if silent == 0:
        return recorder
    layers[silent - 1].env = recorder
    return env


def states_of(env: gym.Env[Any, Any]) -> list[State]:
    """Return the states of an environment and its wrappers after `prepare`, the outermost first."""
    return [{"class": type(layer).__name__, **_state_of(layer)} for layer in _layers(env)]


def set_states(env: gym.Env[Any, Any], states: list[State]) -> str | None:
    """Restore the states from `states_of` after a reset; return why the episode cannot resume where it was, or None."""
    layers = list(_layers(env))
    there = [state["class"] for state in states]
    here = [type(layer).__name__ for layer in layers]
    if here != there:
        raise ValueError(f"The environment is {' around '.join(here)}; its checkpoint is of {' around '.join(there)}.")
    failure = None
    for layer, state in zip(layers, states, strict=True):  # layers beneath a RecordActions come after it
        if "own" in state:
            set_own_state(layer, state["own"])
        if "random" in state:
            set_random_states(layer, state["random"])
        if isinstance(layer, Monitor):
            _set_monitor_state(layer, state)
        if isinstance(layer, RecordActions):
            failure = failure or layer.failure()
    return failure


def _layers(env: Any) -> Iterator[Any]:
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env
    yield env


def _tells(layer: Any) -> bool:
    """Return whether the state of a layer is known. Beneath a `RecordActions` it need not be."""
    known = _own(layer) or isinstance(layer, (Monitor, *REMEMBER_NOTHING))
    return known or (isinstance(layer, gym.Wrapper) and getattr(layer, "remembers_nothing", False))


def _own(layer: Any) -> bool:
    """Return whether a layer has a state of its own, or a declared one."""
    return hasattr(layer, "get_state") or hasattr(layer, "STATE") or type(layer) in FOREIGN


def _state_of(layer: Any) -> State:
    state: State = {"own": own_state(layer)} if _own(layer) else {}
    if state and not isinstance(layer, gym.Wrapper):
        state["random"] = random_states(layer)
    return state | _monitor_state(layer) if isinstance(layer, Monitor) else state


def _monitor_state(monitor: Monitor[Any, Any]) -> State:
    writer = monitor.results_writer
    return {
        "elapsed": time.time() - monitor.t_start,
        "lists": {name: np.array(getattr(monitor, name)) for name in MONITOR_LISTS},
        "needs_reset": monitor.needs_reset,
        "total_steps": monitor.total_steps,
        "reset_info": dict(monitor.current_reset_info),
        "bytes": None if writer is None else Path(writer.file_handler.name).stat().st_size,
    }


def _set_monitor_state(monitor: Monitor[Any, Any], state: State) -> None:
    monitor.t_start = time.time() - state["elapsed"]
    for name in MONITOR_LISTS:
        setattr(monitor, name, state["lists"][name].tolist())
    monitor.needs_reset = state["needs_reset"]
    monitor.total_steps = state["total_steps"]
    monitor.current_reset_info = state["reset_info"]
    if monitor.results_writer is not None and state["bytes"] is not None:
        file = monitor.results_writer.file_handler
        if Path(file.name).stat().st_size >= state["bytes"]:
            os.truncate(file.name, state["bytes"])  # it is open for appending
