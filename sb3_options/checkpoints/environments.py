"""The state of a `VecEnv`: what SB3's wrappers remember, and each environment in mid-episode."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_options.checkpoints.records import RECORDS
from sb3_options.checkpoints.tree import State, encode
from sb3_options.execution import layers
from sb3_options.execution.slots import OptionSlots

REMEMBER_NOTHING = (VecTransposeImage, VecCheckNan, VecExtractDictObs)


def get_state(venv: VecEnv) -> State:
    """Between two steps.

    Raises:
        ValueError: Something in it does not tell its state.
    """
    wrappers = []
    while isinstance(venv, VecEnvWrapper):
        wrappers.append({"class": type(venv).__name__, "state": _wrapper_state(venv)})
        venv = venv.venv
    # An environment for evaluation that was not yet reset has still to be seeded.
    seeds, options = list(venv._seeds), [dict(each) for each in venv._options]
    return {"wrappers": wrappers, "environments": _states(venv), "seeds": seeds, "options": options}


def refusal(venv: VecEnv | None) -> str | None:
    """Why there can be no checkpoints of an environment; None if there can."""
    try:
        encode(get_state(venv), RECORDS)  # type: ignore[arg-type]  # a model without an environment is not trained
    except (ValueError, TypeError) as error:
        return str(error)
    return None


def set_state(venv: VecEnv, state: State) -> None:
    """Go on with what `get_state` gave, in environments that were made alike and have been reset.

    Raises:
        ValueError: They were not made alike.
    """
    for wrapper in state["wrappers"]:
        if type(venv).__name__ != wrapper["class"]:
            raise ValueError(f"The checkpoint is of environments in {wrapper['class']}, here is {type(venv).__name__}.")
        assert isinstance(venv, VecEnvWrapper)
        _set_wrapper_state(venv, wrapper["state"])
        venv = venv.venv
    if isinstance(venv, VecEnvWrapper) or venv.num_envs != len(state["environments"]):
        raise ValueError(
            f"The checkpoint is of {len(state['environments'])} environments, here are {venv.num_envs} in "
            f"{type(venv).__name__}."
        )
    venv._seeds, venv._options = state["seeds"], state["options"]
    for i, states in enumerate(state["environments"]):
        if isinstance(venv, DummyVecEnv):
            layers.set_states(venv.envs[i], states)
        else:
            venv.env_method("set_layer_states", states, indices=[i])


def _states(venv: VecEnv) -> list[list[State]]:
    if isinstance(venv, DummyVecEnv):
        return [layers.states_of(env) for env in venv.envs]
    if isinstance(venv, SubprocVecEnv):
        if not all(venv.env_is_wrapped(OptionSlots)):
            raise ValueError("Checkpoints of environments in worker processes need OptionsWrapper around each of them.")
        if any(venv.env_is_wrapped(_AboveOptions)):  # type: ignore[arg-type]  # it is asked whether they are instances
            raise ValueError(
                "Checkpoints of wrappers above OptionsWrapper in worker processes are not supported yet: put them "
                "beneath it."
            )
        found = venv.env_method("layer_states")
        for each in found:
            if isinstance(each, str):
                raise ValueError(each)
        return list(found)
    raise ValueError(f"Checkpoints of {type(venv).__name__} are not supported yet.")


class _Kind(type):
    def __instancecheck__(cls, env: Any) -> bool:
        return isinstance(env, gym.Wrapper) and not isinstance(env, OptionSlots) and is_wrapped(env, OptionSlots)


class _AboveOptions(metaclass=_Kind):
    """Any wrapper above `OptionsWrapper`, for ``VecEnv.env_is_wrapped``."""


def _wrapper_state(venv: VecEnvWrapper) -> State:
    if isinstance(venv, VecNormalize):
        running = venv.obs_rms if isinstance(venv.obs_rms, dict) else {"": venv.obs_rms} if venv.norm_obs else {}
        return {
            "observations": {key: _statistics(each) for key, each in running.items()},
            "rewards": _statistics(venv.ret_rms),
            "returns": venv.returns,
            "old": (venv.old_obs, venv.old_reward),
        }
    if isinstance(venv, VecFrameStack):
        return {"frames": {key: stack.stacked_obs for key, stack in _stacks(venv).items()}}
    if type(venv) in REMEMBER_NOTHING:
        return {}
    raise ValueError(f"Checkpoints of {type(venv).__name__} are not supported yet.")


def _set_wrapper_state(venv: VecEnvWrapper, state: State) -> None:
    if isinstance(venv, VecNormalize):
        running = venv.obs_rms if isinstance(venv.obs_rms, dict) else {"": venv.obs_rms}
        for key, statistics in state["observations"].items():
            _set_statistics(running[key], statistics)
        _set_statistics(venv.ret_rms, state["rewards"])
        venv.returns = state["returns"]
        venv.old_obs, venv.old_reward = state["old"]
    if isinstance(venv, VecFrameStack):
        for key, stack in _stacks(venv).items():
            stack.stacked_obs = state["frames"][key]


def _stacks(venv: VecFrameStack) -> dict[str, StackedObservations[Any]]:
    top: Any = venv.stacked_obs
    return dict(top.sub_stacked_observations) if hasattr(top, "sub_stacked_observations") else {"": top}


def _statistics(running: RunningMeanStd) -> State:
    return {"mean": running.mean, "var": running.var, "count": running.count}


def _set_statistics(running: RunningMeanStd, state: State) -> None:
    running.mean, running.var, running.count = state["mean"], state["var"], state["count"]
