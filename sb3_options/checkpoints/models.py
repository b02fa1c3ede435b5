"""The state of a model and of every random generator, at the start of a rollout."""

import os
import random
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from sb3_options.checked import is_number, whole
from sb3_options.checkpoints.tree import State
from sb3_options.learning.families import family_of
from sb3_options.learning.macro_q import MacroQ
from sb3_options.learning.replay_buffer import Growing, OptionReplayBuffer
from sb3_options.learning.rollout_buffer import option_rollout_buffer

SUPPORTED = ("DQN", "OptionDQN", "QRDQN", "PPO", "MaskablePPO", "A2C", "TRPO", "RecurrentPPO", "MacroQ")
LIBRARIES = ("stable_baselines3", "sb3_contrib", "sb3_options")
"""Class names of models whose whole state is known, and their libraries."""

COUNTERS = (
    "num_timesteps",
    "_num_timesteps_at_start",
    "_episode_num",
    "_n_updates",
    "_n_calls",
    "_current_progress_remaining",
    "exploration_rate",
    "_steps_seen",
    "_untrained_steps",
    "_untrained_decisions",
    "_options_since",
)
# Attributes of a logger, by their names in a checkpoint.
LOGGED = {"values": "name_to_value", "counts": "name_to_count", "excluded": "name_to_excluded"}
LAST = ("_last_obs", "_last_original_obs", "_last_episode_starts")  # last outputs of the environments


def check(model: BaseAlgorithm) -> None:
    """Refuse a model whose whole state a checkpoint would not hold."""
    of = type(model)
    if of.__name__ not in SUPPORTED or of.__module__.partition(".")[0] not in LIBRARIES or model.use_sde:
        raise ValueError(
            f"Checkpoints of {of.__name__} are not supported yet; those of {', '.join(SUPPORTED)} are, without use_sde."
        )
    family_of(model).prepare()


def get_state(model: BaseAlgorithm) -> State:
    """Return networks, optimizer, replay buffer and counters. A rollout buffer is empty at this point."""
    memory = getattr(model, "_last_lstm_states", None)  # in RecurrentPPO
    state: State = {
        "class": type(model).__name__,
        "gamma": getattr(model, "gamma", None),
        "policy": dict(model.policy.state_dict()),
        "optimizer": model.policy.optimizer.state_dict() if hasattr(model.policy, "optimizer") else None,
        "choices": model._random.bit_generator.state if isinstance(model, MacroQ) else None,
        "memory": None if memory is None else [tuple(of_network) for of_network in memory],
        "counters": {name: getattr(model, name) for name in COUNTERS if hasattr(model, name)},
        "last": {name: getattr(model, name, None) for name in LAST},
        "rollout": _rollout(model),
        "elapsed": time.time_ns() - model.start_time,
        "episodes": list(model.ep_info_buffer or ()),
        "successes": list(model.ep_success_buffer or ()),
        "action_space": model.action_space.np_random.bit_generator.state,
    }
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        state["replay_buffer"] = buffer.get_state()
    return state


def growing(model: BaseAlgorithm) -> list[Growing]:
    """Return the large arrays in `get_state` that record how they have grown."""
    buffer = getattr(model, "replay_buffer", None)
    return [] if buffer is None else buffer.growing()


def _rollout(model: BaseAlgorithm) -> State:
    """Return the length of the rollout that begins, in decisions, and in primitive steps if these count."""
    buffer = getattr(model, "rollout_buffer", None)
    sizes = {"n_steps": "buffer_size", "n_primitive_steps": "n_primitive_steps"}  # by attribute
    return {name: size for name, of in sizes.items() if (size := getattr(buffer, of, None)) is not None}


def prepare(model: BaseAlgorithm, state: State) -> None:
    """Give the first on-policy rollout the length of the rollout that began when `get_state` was called."""
    sizes = state["rollout"]
    buffer: Any = getattr(model, "rollout_buffer", None)
    if buffer is None or "n_steps" not in sizes:
        return
    most: int = model.n_steps  # type: ignore[attr-defined]  # it is on-policy
    for steps in sizes.values():
        if not (whole(steps, 1) and steps <= most):
            raise ValueError(f"The checkpoint is of rollouts of {steps!r} steps, and the model has n_steps={most}.")
    if "n_primitive_steps" in sizes:
        buffer = option_rollout_buffer(model)
        buffer.n_primitive_steps = sizes["n_primitive_steps"]
    model.n_steps = buffer.buffer_size = sizes["n_steps"]  # type: ignore[attr-defined]  # it is on-policy


def set_state(model: BaseAlgorithm, state: State) -> None:
    """Continue from a state of `get_state`, in a model made with the same arguments."""
    counters = {name: state["counters"][name] for name in COUNTERS if name in state["counters"]}
    for name, value in counters.items():
        if not (is_number(value) if isinstance(getattr(model, name, 0), float) else whole(value, 0)):
            raise ValueError(f"The checkpoint has {name}={value!r}, which is no count of steps, or no rate.")
    gamma = getattr(model, "gamma", None)
    if state["gamma"] != gamma:
        raise ValueError(f"The checkpoint is of training with gamma={state['gamma']}, the model has gamma={gamma}.")
    model.policy.load_state_dict(state["policy"])
    if state["optimizer"] is not None:
        model.policy.optimizer.load_state_dict(state["optimizer"])
    if isinstance(model, MacroQ):
        model._random.bit_generator.state = state["choices"]
    if state["memory"] is not None:
        memory = (tuple(each.to(model.device) for each in of_network) for of_network in state["memory"])
        model._last_lstm_states = type(model._last_lstm_states)(*memory)  # type: ignore[attr-defined]  # it is recurrent
    last = {name: state["last"][name] for name in LAST}
    for name, value in (counters | last).items():  # no other names from a stranger's file
        setattr(model, name, value)
    model.start_time = time.time_ns() - state["elapsed"]
    for buffer, episodes in ((model.ep_info_buffer, "episodes"), (model.ep_success_buffer, "successes")):
        assert buffer is not None  # learn() has begun
        buffer.clear()
        buffer.extend(state[episodes])
    model.action_space.np_random.bit_generator.state = state["action_space"]
    if "replay_buffer" in state:
        replay: OptionReplayBuffer = model.replay_buffer  # type: ignore[attr-defined]  # as when it was written
        replay.set_state(state["replay_buffer"])
        if not (whole(replay.pos, 0) and replay.pos < replay.buffer_size):
            raise ValueError(f"The checkpoint writes to row {replay.pos!r} of a buffer of {replay.buffer_size}.")


def begin_episodes(model: BaseAlgorithm) -> None:
    """Reset the environments between two rollouts."""
    venv = model.get_env()
    assert venv is not None  # learn() has begun
    model._last_obs = venv.reset()  # type: ignore[assignment]  # as SB3 does
    model._last_episode_starts = np.ones(venv.num_envs, dtype=bool)
    if model._vec_normalize_env is not None:
        model._last_original_obs = model._vec_normalize_env.get_original_obs()


def random_states() -> State:
    """Return the states of the global generators: Python's, numpy's and torch's."""
    kind, keys, pos, has_gauss, cached = np.random.get_state(legacy=True)  # noqa: NPY002  # SB3 draws from it
    version, numbers, gauss = random.getstate()
    return {
        "numpy": (kind, keys, pos, has_gauss, cached),
        "python": (version, np.array(numbers, dtype=np.int64), gauss),
        "torch": torch.get_rng_state(),
        "cuda": list(torch.cuda.get_rng_state_all()) if torch.cuda.is_available() else [],
    }


def set_random_states(state: State) -> None:
    """Restore the states of all generators from `random_states`."""
    np.random.set_state(state["numpy"])  # noqa: NPY002  # SB3 draws from it
    version, numbers, gauss = state["python"]
    random.setstate((version, tuple(numbers.tolist()), gauss))
    torch.set_rng_state(state["torch"])
    if torch.cuda.is_available() and state["cuda"]:
        torch.cuda.set_rng_state_all(state["cuda"][: torch.cuda.device_count()])  # there may be fewer here


def logged(logger: Logger) -> State:
    """Return the numbers that are recorded but not yet written."""
    told = {name for name, value in logger.name_to_value.items() if isinstance(value, int | float | np.number | str)}
    return {key: {n: v for n, v in getattr(logger, name).items() if n in told} for key, name in LOGGED.items()}


def set_logged(logger: Logger, state: State) -> None:
    """Replace the recorded numbers by those from `logged`."""
    for key, name in LOGGED.items():
        recorded = getattr(logger, name)
        recorded.clear()
        recorded.update(state[key])


def event_file_sizes(logger: Logger) -> dict[str, int]:
    """Flush the event files of a logger, and return their sizes in bytes by name."""
    for writer in _writers(logger):
        writer.flush()
    return {file.name: file.stat().st_size for file in _event_files(logger)}


def cut_event_files(logger: Logger, before: dict[str, int]) -> None:
    """Remove the points that earlier processes logged after a checkpoint."""
    files = _event_files(logger)
    if not any(file.name in before for file in files):
        return  # the logger writes to a new folder: leave its files alone
    own = {Path(writer.file_writer.event_writer._file_name).name for writer in _writers(logger)}
    for file in files:
        if file.name in before:
            os.truncate(file, min(before[file.name], file.stat().st_size))
        elif file.name not in own:
            file.unlink()


def _event_files(logger: Logger) -> list[Path]:
    return sorted(Path(logger.dir).glob("*tfevents*")) if _writers(logger) and logger.dir is not None else []


def _writers(logger: Logger) -> list[Any]:
    """Return the open TensorBoard writers."""
    return [output.writer for output in logger.output_formats if isinstance(output, TensorBoardOutputFormat)]
