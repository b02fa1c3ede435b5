"""The state of a `VecEnv`: the memory of SB3's wrappers, and each environment in mid-episode."""

from collections.abc import Callable
from typing import Any

from stable_baselines3.common import vec_env
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_options.checkpoints.tree import State, encode
from sb3_options.execution import layers
from sb3_options.execution.above import Outermost
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.state import declare, restore, state_of

declare(VecNormalize, "obs_rms", "ret_rms", "returns", "old_obs", "old_reward")
declare(vec_env.VecFrameStack, "stacked_obs")
declare(StackedObservations, "stacked_obs", "sub_stacked_observations")
declare(RunningMeanStd, "mean", "var", "count")

REMEMBER_NOTHING = (vec_env.VecTransposeImage, vec_env.VecCheckNan, vec_env.VecExtractDictObs)


def prepare(venv: VecEnv, *, just_reset: bool = False) -> None:
    """Start recording for a resume in mid-episode, before `get_state`. A second call does nothing."""
    while isinstance(venv, VecEnvWrapper):
        _wrapper_state(venv)
        venv = venv.venv
    if isinstance(venv, DummyVecEnv):
        venv.envs = [layers.prepare(env, just_reset=just_reset) for env in venv.envs]
        return
    _check_supported(venv, SubprocVecEnv)
    if not all(venv.env_is_wrapped(OptionsWrapper)):
        raise ValueError("Checkpoints of environments in worker processes need OptionsWrapper around each of them.")
    venv.env_is_wrapped(Outermost)  # type: ignore[arg-type]  # it is asked whether they are instances
    _in_workers(venv, _prepare, just_reset)


def _prepare(env: Any, just_reset: bool) -> None:
    layers.prepare(env, just_reset=just_reset)  # the result is the same environment, and stays in its process


def get_state(venv: VecEnv) -> State:
    """Return the state between two steps, after `prepare`."""
    wrappers = []
    while isinstance(venv, VecEnvWrapper):
        wrappers.append({"class": type(venv).__name__, "state": _wrapper_state(venv)})
        venv = venv.venv
    # An evaluation environment without a reset is still to be seeded.
    seeds, options = list(venv._seeds), [dict(each) for each in venv._options]
    if isinstance(venv, DummyVecEnv):
        states = [layers.states_of(env) for env in venv.envs]
    else:
        states = _in_workers(venv, layers.states_of)
    return {"wrappers": wrappers, "environments": states, "seeds": seeds, "options": options}


def refusal(venv: VecEnv | None) -> str | None:
    """Say why an environment cannot have checkpoints; if it can, prepare it and return None."""
    try:
        prepare(venv)  # type: ignore[arg-type]  # a model without an environment is not trained
        encode(get_state(venv))  # type: ignore[arg-type]  # likewise
    except (ValueError, TypeError) as error:
        return str(error)
    return None


def set_state(venv: VecEnv, state: State) -> list[str]:
    """Restore a state in prepared environments. Return which episodes cannot continue, and why."""
    for wrapper in state["wrappers"]:
        if type(venv).__name__ != wrapper["class"]:
            raise ValueError(f"The checkpoint is of environments in {wrapper['class']}, here is {type(venv).__name__}.")
        assert isinstance(venv, VecEnvWrapper)
        if wrapper["state"]:
            restore(venv, wrapper["state"])
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
            (failure,) = _in_workers(venv, layers.set_states, states, indices=[i])
        if failure is not None:
            failures.append(f"environment {i}: {failure}")
    return failures


def _wrapper_state(venv: VecEnvWrapper) -> State:
    if type(venv) in REMEMBER_NOTHING:
        return {}
    _check_supported(venv, VecNormalize, vec_env.VecFrameStack)
    return state_of(venv)


def _check_supported(venv: VecEnv, *kinds: type[VecEnv]) -> None:
    if not isinstance(venv, kinds):
        raise ValueError(
            f"Checkpoints of {type(venv).__name__} are not supported: it does not tell where its episodes are. Save "
            "the model with Stable-Baselines3's CheckpointCallback, and load it with sb3_options.load_model."
        )


def _in_workers(venv: VecEnv, function: Callable[..., Any], *args: Any, indices: list[int] | None = None) -> list[Any]:
    """Return the results of a function in all worker processes, or those of ``indices``; raise its error here."""
    results = venv.env_method("on_layers", function, *args, indices=indices)
    for _, why in results:
        if why is not None:
            raise ValueError(why)
    return [result for result, _ in results]
