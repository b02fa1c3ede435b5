"""The state of a `VecEnv`: what SB3's wrappers remember, and each environment in mid-episode."""

from __future__ import annotations

from typing import Any

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

from sb3_options.checkpoints.tree import State, encode
from sb3_options.execution import layers
from sb3_options.execution.above import Outermost
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.state import restore, state_of

REMEMBER_NOTHING = (VecTransposeImage, VecCheckNan, VecExtractDictObs)


def prepare(venv: VecEnv, *, just_reset: bool = False) -> None:
    """Record what resuming in mid-episode needs; `get_state` requires it. A second call does nothing."""
    while isinstance(venv, VecEnvWrapper):
        _wrapper_state(venv)
        venv = venv.venv
    if isinstance(venv, DummyVecEnv):
        venv.envs = [layers.prepare(env, just_reset=just_reset) for env in venv.envs]
        return
    if not isinstance(venv, SubprocVecEnv):
        raise ValueError(f"Checkpoints of {type(venv).__name__} are not supported yet.")
    if not all(venv.env_is_wrapped(OptionsWrapper)):
        raise ValueError("Checkpoints of environments in worker processes need OptionsWrapper around each of them.")
    venv.env_is_wrapped(Outermost)  # type: ignore[arg-type]  # it is asked whether they are instances
    for why in venv.env_method("prepare_layers", just_reset):
        if why is not None:
            raise ValueError(why)


def get_state(venv: VecEnv) -> State:
    """Between two steps, after `prepare`."""
    wrappers = []
    while isinstance(venv, VecEnvWrapper):
        wrappers.append({"class": type(venv).__name__, "state": _wrapper_state(venv)})
        venv = venv.venv
    # An environment for evaluation that was not yet reset has still to be seeded.
    seeds, options = list(venv._seeds), [dict(each) for each in venv._options]
    if isinstance(venv, DummyVecEnv):
        states = [layers.states_of(env) for env in venv.envs]
    else:
        states = list(venv.env_method("layer_states"))
    return {"wrappers": wrappers, "environments": states, "seeds": seeds, "options": options}


def refusal(venv: VecEnv | None) -> str | None:
    """Why there can be no checkpoints of an environment; None if there can, and it is prepared."""
    try:
        prepare(venv)  # type: ignore[arg-type]  # a model without an environment is not trained
        encode(get_state(venv))  # type: ignore[arg-type]  # likewise
    except (ValueError, TypeError) as error:
        return str(error)
    return None


def set_state(venv: VecEnv, state: State) -> list[str]:
    """Continue from `get_state` in prepared environments; returns in which of them the episode cannot, and why."""
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
    failures = []
    for i, states in enumerate(state["environments"]):
        if isinstance(venv, DummyVecEnv):
            failure = layers.set_states(venv.envs[i], states)
        else:
            ((failure, wrong),) = venv.env_method("set_layer_states", states, indices=[i])
            if wrong is not None:
                raise ValueError(wrong)
        if failure is not None:
            failures.append(f"environment {i}: {failure}")
    return failures


def _wrapper_state(venv: VecEnvWrapper) -> State:
    if isinstance(venv, VecNormalize):
        return {
            "observations": {key: state_of(each) for key, each in _running(venv).items()},
            "rewards": state_of(venv.ret_rms),
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
        running = _running(venv)
        for key, statistics in state["observations"].items():
            restore(running[key], statistics)
        restore(venv.ret_rms, state["rewards"])
        venv.returns = state["returns"]
        venv.old_obs, venv.old_reward = state["old"]
    if isinstance(venv, VecFrameStack):
        for key, stack in _stacks(venv).items():
            stack.stacked_obs = state["frames"][key]


def _running(venv: VecNormalize) -> dict[str, RunningMeanStd]:
    """Those of observations; none where these are not normalised."""
    if not venv.norm_obs:
        return {}
    return venv.obs_rms if isinstance(venv.obs_rms, dict) else {"": venv.obs_rms}


def _stacks(venv: VecFrameStack) -> dict[str, StackedObservations[Any]]:
    top: Any = venv.stacked_obs
    return dict(top.sub_stacked_observations) if hasattr(top, "sub_stacked_observations") else {"": top}
