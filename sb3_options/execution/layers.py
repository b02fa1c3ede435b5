"""The state of an environment in mid-episode: that of each of its wrappers, and of what they are around.

An environment that gives and takes its state has ``get_state()`` and ``set_state(state)``, of numbers, text, arrays,
lists and dictionaries. Its ``np_random`` need not be in it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import wrappers
from stable_baselines3.common.monitor import Monitor

State = dict[str, Any]

REMEMBER_NOTHING = (
    wrappers.PassiveEnvChecker,  # it checks the first step once more
    wrappers.TransformAction,
    wrappers.TransformObservation,
    wrappers.TransformReward,
)
"""Wrappers, with the classes derived from them, that are the same in every step."""


class _Layer(NamedTuple):
    get: Callable[[Any], State]
    set: Callable[[Any, State], None]


def states_of(env: gym.Env[Any, Any]) -> list[State]:
    """The states of an environment and its wrappers, the outermost first.

    Raises:
        ValueError: One of them does not tell its state.
    """
    return [{"class": type(layer).__name__, **_how(layer).get(layer)} for layer in _layers(env)]


def set_states(env: gym.Env[Any, Any], states: list[State]) -> None:
    """Go on with what `states_of` gave, in an environment that was made alike and has been reset.

    Raises:
        ValueError: It is wrapped otherwise.
    """
    layers = list(_layers(env))
    here, there = [type(layer).__name__ for layer in layers], [state["class"] for state in states]
    if here != there:
        raise ValueError(f"The environment is {' around '.join(here)}; its checkpoint is of {' around '.join(there)}.")
    for layer, state in zip(layers, states, strict=True):
        _how(layer).set(layer, state)


def _layers(env: Any) -> Iterator[Any]:
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env
    yield env


def _how(layer: Any) -> _Layer:
    """How a layer gives and takes its state.

    Raises:
        ValueError: It does not.
    """
    own = hasattr(layer, "get_state") and hasattr(layer, "set_state")
    if not isinstance(layer, gym.Wrapper):
        if not own:
            raise ValueError(
                f"Checkpoints of {type(layer).__name__} are not supported yet: the environment does not tell where "
                "its episode is. Give it get_state() and set_state(state)."
            )
        return _ENVIRONMENT
    if own:
        return _Layer(lambda wrapper: {"own": wrapper.get_state()}, lambda wrapper, s: wrapper.set_state(s["own"]))
    if isinstance(layer, Monitor):
        return _MONITOR
    for cls, names in ATTRIBUTES.items():
        if type(layer) is cls:
            return _by_attributes(names)
    if isinstance(layer, REMEMBER_NOTHING) or getattr(layer, "remembers_nothing", False):
        return _by_attributes(())
    raise ValueError(
        f"Checkpoints of {type(layer).__name__} are not supported yet: give the wrapper get_state() and "
        "set_state(state), or the attribute remembers_nothing = True if it is the same in every step."
    )


ATTRIBUTES: dict[type[Any], tuple[str, ...]] = {
    wrappers.TimeLimit: ("_elapsed_steps",),
    wrappers.OrderEnforcing: ("_has_reset",),
    wrappers.Autoreset: ("autoreset",),
}
"""What wrappers of Gymnasium remember."""


def _by_attributes(names: tuple[str, ...]) -> _Layer:
    def put(layer: Any, state: State) -> None:
        for name in names:
            setattr(layer, name, state["own"][name])

    return _Layer(lambda layer: {"own": {name: getattr(layer, name) for name in names}}, put)


def _environment_state(env: Any) -> State:
    spaces = {name: getattr(env, name)._np_random for name in ("action_space", "observation_space")}
    return {
        "own": env.get_state(),
        "np_random": env.np_random.bit_generator.state,
        "spaces": {name: random and random.bit_generator.state for name, random in spaces.items()},
    }


def _set_environment_state(env: Any, state: State) -> None:
    env.set_state(state["own"])
    env.np_random.bit_generator.state = state["np_random"]
    for name, random in state["spaces"].items():
        if random is not None:
            getattr(env, name).np_random.bit_generator.state = random


_ENVIRONMENT = _Layer(_environment_state, _set_environment_state)


def _monitor_state(monitor: Monitor[Any, Any]) -> State:
    writer = monitor.results_writer
    return {
        "elapsed": time.time() - monitor.t_start,
        "rewards": np.array(monitor.rewards),
        "needs_reset": monitor.needs_reset,
        "returns": np.array(monitor.episode_returns),
        "lengths": np.array(monitor.episode_lengths, dtype=np.int64),
        "times": np.array(monitor.episode_times),
        "total_steps": monitor.total_steps,
        "reset_info": dict(monitor.current_reset_info),
        "bytes": None if writer is None else Path(writer.file_handler.name).stat().st_size,
    }


def _set_monitor_state(monitor: Monitor[Any, Any], state: State) -> None:
    monitor.t_start = time.time() - state["elapsed"]
    monitor.rewards, monitor.needs_reset = state["rewards"].tolist(), state["needs_reset"]
    monitor.episode_returns, monitor.episode_lengths = state["returns"].tolist(), state["lengths"].tolist()
    monitor.episode_times, monitor.total_steps = state["times"].tolist(), state["total_steps"]
    monitor.current_reset_info = state["reset_info"]
    if monitor.results_writer is not None and state["bytes"] is not None:
        file = monitor.results_writer.file_handler
        if Path(file.name).stat().st_size >= state["bytes"]:
            os.truncate(file.name, state["bytes"])  # it is open for appending


_MONITOR = _Layer(_monitor_state, _set_monitor_state)
