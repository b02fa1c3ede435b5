"""The models of the command line."""

import importlib
import inspect
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import gymnasium as gym
from pydantic import ConfigDict, ValidationError, create_model
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.checked import readable
from sb3_options.embedding.encoders import MIN_IMAGE
from sb3_options.extras import how_to_install
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.runs.config import ALGORITHMS, FIELDS, OFF_POLICY, Count, TrainConfig, unknown

RESERVED = frozenset({"self", "policy", "env", "verbose", "_init_setup_model"}) | {
    f"{kind}_buffer_{what}" for kind in ("replay", "rollout") for what in ("class", "kwargs")
}
"""Arguments of SB3's classes that the library sets itself."""


def class_of(algo: str) -> Any:
    """Import and return the class of an algorithm."""
    module, name = ALGORITHMS[algo]
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{name} needs sb3-contrib: {how_to_install('contrib')}") from error


def arguments_of(algo: str) -> dict[str, inspect.Parameter]:
    """Return the arguments of an algorithm that are not settings of `TrainConfig`.

    They include the shorthand ``net_arch``, and for off-policy algorithms the replay buffer's ``n_steps``.
    """
    found: dict[str, inspect.Parameter] = {}
    for of in inspect.getmro(class_of(algo)):  # OptionDQN passes other arguments on to DQN
        if "__init__" in vars(of):
            found = dict(inspect.signature(vars(of)["__init__"], eval_str=True).parameters) | found
        if "learning_rate" in found:
            break
    extra = {"net_arch": list[Count]} | ({"n_steps": int} if algo in OFF_POLICY else {})
    for name, annotation in extra.items():
        found[name] = inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation)
    kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return {n: p for n, p in found.items() if n not in RESERVED and n not in FIELDS and p.kind not in kinds}


def checked_arguments(algo: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Check arguments of an algorithm against the signature of its class."""
    arguments = arguments_of(algo)
    for name in values:
        if name not in arguments:
            raise ValueError(unknown(str(name), arguments))
    fields: dict[str, Any] = {name: (arguments[name].annotation, ...) for name in values}
    config = ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)
    try:
        model = create_model("Arguments", __config__=config, **fields)(**values)
    except ValidationError as error:
        raise ValueError(readable(error)) from None
    return {name: getattr(model, name) for name in values}


def make_model(config: TrainConfig, env: VecEnv, *, playing: bool = False) -> BaseAlgorithm:
    """Make the untrained model of a run."""
    space = env.observation_space
    # NatureCNN takes no smaller pictures, such as a view of 7 x 7 cells.
    image = is_image_space(space) and min(sorted(space.shape or ())[1:]) >= MIN_IMAGE
    policy = "MultiInput" if isinstance(space, gym.spaces.Dict) else "Cnn" if image else "Mlp"
    arguments = deepcopy(config.algo_kwargs)  # SB3's classes write into policy_kwargs
    if config.algo in OFF_POLICY:
        # The callback sets the rollout buffers of on-policy algorithms.
        arguments["replay_buffer_class"] = OptionReplayBuffer
        n_steps = arguments.pop("n_steps", None)
        arguments["replay_buffer_kwargs"] = {} if n_steps is None else {"n_steps": n_steps}
    if playing:
        arguments |= {"buffer_size": 1} if config.algo in OFF_POLICY else {"n_steps": arguments.get("batch_size", 2)}
    try:
        model: BaseAlgorithm = class_of(config.algo)(
            f"{policy}{'Lstm' if config.algo == 'recurrentppo' else ''}Policy",
            env,
            seed=config.seed,
            gamma=config.gamma,
            **arguments,
        )
    except (AssertionError, RuntimeError) as error:  # how SB3 and torch refuse arguments
        raise ValueError(f"{config.algo}: {error}") from error
    # SB3 seeds environment i with seed + i, so runs with seeds 0 and 1 would share all environments but one.
    env.seed(config.seed * env.num_envs)
    return model
