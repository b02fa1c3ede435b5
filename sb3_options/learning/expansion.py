"""`expand_action_space`: adds option slots to a model that was trained without them."""

from typing import TypeVar

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_options.embedding.settings import MapName
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.observations import FeatureMap
from sb3_options.learning.checks import check_gamma, check_wrapped
from sb3_options.learning.families import Networks, family_of

Model = TypeVar("Model", bound=BaseAlgorithm)


def expand_action_space(
    model: Model, max_options: int = 4, *, env: GymEnv | None = None, feature_map: FeatureMap | MapName | None = None
) -> Model:
    """Add option slots to a trained model, in place, and keep everything that it has learned.

    Weights, target network, optimizer moments, counters and schedules are kept. The outputs for the old actions stay
    the same, except for the rounding of a product with more rows, also after options were installed. The new heads are
    closed. The model's environments are wrapped in `OptionsWrapper` (a ``Monitor`` stays beneath it) and reset when
    training goes on. An empty `OptionReplayBuffer` replaces a stock replay buffer.

    Continue with ``model.learn(..., callback=SubgoalDiscoveryCallback(), reset_num_timesteps=False)``. An evaluation
    environment must be wrapped by hand, with as many slots.

    Args:
        model: DQN, QRDQN, PPO, A2C, TRPO, MaskablePPO or RecurrentPPO, trained on an environment without options.
        max_options: Number of slots, at least 1.
        env: Replaces the model's environment; wrapped in `OptionsWrapper`, with ``max_options`` slots, the model's γ
            and, if wanted, ``max_runs``. Needed if the model has no environment, or if its environments live in other
            processes.
        feature_map: Feature map for `OptionsWrapper`; not together with ``env``.

    Returns:
        The same model.

    Raises:
        TypeError: Actions are not discrete, or the policy is of an unknown kind.
        ValueError: The model has slots already, or ``env`` is missing or does not fit. Then nothing has been changed.
    """
    family = family_of(model)
    actions = model.action_space
    if not (isinstance(family, Networks) and isinstance(actions, spaces.Discrete)):
        raise TypeError(f"{type(model).__name__} has no networks with an output for each of its actions, {actions}.")
    n_primitive = int(actions.n)
    if model.env is not None and any(model.env.env_is_wrapped(OptionsWrapper)):
        raise ValueError(
            f"The model's environment is wrapped in OptionsWrapper already: among its {n_primitive} actions are "
            "option slots, and their number cannot be changed any more."
        )
    family.check_heads()
    venv = _fitting(model, env, n_primitive, max_options, feature_map)
    # The same generator lets exploration continue.
    family.widen(spaces.Discrete(n_primitive + max_options, seed=actions.np_random))
    model.set_env(venv)
    return model


def _fitting(
    model: BaseAlgorithm,
    env: GymEnv | None,
    n_primitive: int,
    max_options: int,
    feature_map: FeatureMap | MapName | None,
) -> VecEnv:
    """Return the environment for further training, checked."""
    gamma: float = model.gamma  # type: ignore[attr-defined]  # every algorithm whose heads are known has it
    if env is None:
        if model.env is None:
            raise ValueError(
                f"The model has no environment: give one to {type(model).__name__}.load(..., env=...), or pass "
                f"expand_action_space(model, {max_options}, env=...) one that is wrapped in OptionsWrapper."
            )
        return _wrap(model.env, max_options, gamma, feature_map)
    if feature_map is not None:
        raise ValueError("feature_map belongs to OptionsWrapper: with env=... pass it to the wrapper in there.")
    venv = model._wrap_env(env, model.verbose)
    check_wrapped(venv, "env")
    has = [each.n_primitive for each in venv.get_attr("traits")]
    if set(has) != {n_primitive}:
        raise ValueError(f"The model chooses among {n_primitive} actions, env has {has[0]} primitive actions.")
    check_gamma(model, venv)
    check_for_correct_spaces(venv, model.observation_space, spaces.Discrete(n_primitive + max_options))
    if venv.num_envs != model.n_envs:
        raise ValueError(
            f"The model was trained with n_envs={model.n_envs}, env has {venv.num_envs}: give as many, or load the "
            f"model with {type(model).__name__}.load(..., env=...) and as many environments without options first."
        )
    return venv


def _wrap(venv: VecEnv, max_options: int, gamma: float, feature_map: FeatureMap | MapName | None) -> VecEnv:
    """Put `OptionsWrapper` around each environment of a ``DummyVecEnv``, beneath any wrappers of the latter."""
    inner = venv.unwrapped
    if not isinstance(inner, DummyVecEnv):
        raise ValueError(
            f"The environments of a {type(inner).__name__} cannot be wrapped from here: pass env=... a new one, such "
            f'as make_vec_env(..., wrapper_class=OptionsWrapper, wrapper_kwargs={{"max_options": {max_options}, '
            f'"gamma": {gamma}}}, vec_env_cls={type(inner).__name__}).'
        )
    wrapped = [OptionsWrapper(env, max_options, gamma=gamma, feature_map=feature_map) for env in inner.envs]
    inner.envs = [*wrapped]
    above: VecEnv = venv
    while isinstance(above, VecEnvWrapper):
        above.action_space = wrapped[0].action_space
        above = above.venv
    inner.action_space = wrapped[0].action_space
    return venv
