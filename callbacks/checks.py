"""Checks of a model and its environment before training starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common import vec_env
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, is_vecenv_wrapped

from sb3_options.callbacks.cloning import can_clone, check_clonable
from sb3_options.callbacks.tree import check_every_step
from sb3_options.execution.above import changing_steps
from sb3_options.execution.options_vec_env import OptionsVecEnv
from sb3_options.learning.checks import check_gamma, check_wrapped
from sb3_options.learning.families import Family, Masked, family_of

if TYPE_CHECKING:
    from sb3_options.callbacks.discovery import SubgoalDiscoveryCallback


def check_training(callback: SubgoalDiscoveryCallback, before: BaseAlgorithm | None) -> None:
    """Refuse training that cannot discover options, and a callback that has served another model, ``before``."""
    check_every_step(callback)
    model = callback.model
    venv = callback.training_env
    made = callback._keeper.made
    check_discovery(model, venv)
    if callback.demonstrations is not None and callback.clone and can_clone(model):
        check_clonable(venv)
    # A reloaded model has the options that the callback made.
    again = before is None or before is model or (made and made <= set(venv.get_attr("bank", [0])[0].filled))
    if not again:
        raise ValueError(
            "This SubgoalDiscoveryCallback was with another model, whose episodes and options it knows: make a new one "
            "for each model."
        )
    traits = venv.get_attr("traits")
    if callback.settings.segmentation == "peaks" and any(each.max_runs is not None for each in traits):
        raise ValueError("max_runs counts in an episode, and a continuing task has none: leave it out with peaks.")
    _check_same("feature maps", [each.feature_kind for each in traits])
    _check_same("max_runs", [each.max_runs for each in traits])


def _check_same(what: str, values: Sequence[Any]) -> None:
    other = next((i for i, value in enumerate(values) if value != values[0]), None)
    if other is not None:
        raise ValueError(
            f"The environments have different {what}: {values[0]} in the first, {values[other]} in number {other}. "
            "Make all of them alike."
        )


def check_options(model: BaseAlgorithm, venv: VecEnv) -> None:
    """Refuse a model or environments in which options would spoil learning."""
    check_wrapped(venv, "The model's environment")
    family = family_of(model)
    family.prepare()
    banks = venv.get_attr("bank")
    if banks[0].max_options:
        family.check(venv)
    if isinstance(family, Masked) and model._last_obs is not None:  # before a reset there are no masks
        _check_masks(venv)
    if is_vecenv_wrapped(venv, OptionsVecEnv) and is_vecenv_wrapped(venv, VecFrameStack):
        raise ValueError(
            "While an option runs, VecFrameStack above OptionsVecEnv would stack copies of one observation: stack "
            "frames in the environment itself."
        )
    if names := changing_steps(venv):
        raise ValueError(
            f"{' and '.join(sorted(names))} above OptionsWrapper may change rewards, observations or episode ends, "
            "without seeing the steps inside options: put it beneath, for instance "
            "OptionsWrapper(TimeLimit(env, 500)). If your own wrapper returns steps unchanged, declare it by the class "
            "attribute returns_steps_unchanged = True."
        )
    check_gamma(model, venv)
    _check_same("options", [[None if option is None else option.name for option in bank.slots] for bank in banks])


def check_discovery(model: BaseAlgorithm, venv: VecEnv) -> None:
    """Refuse a model or an environment for which no options can be discovered."""
    check_options(model, venv)
    _check_nothing_above_changes_observations(venv)
    if type(family_of(model)) is Family:
        raise TypeError(
            f"Options can be discovered for algorithms of Stable-Baselines3 with rollouts or a replay buffer, and for "
            f"MacroQ: {type(model).__name__} is neither."
        )
    if venv.get_attr("traits", [0])[0].feature_kind is None:
        raise ValueError(
            f"There is no default feature map for {venv.observation_space}: pass OptionsWrapper(env, "
            "feature_map=...) a function from a batch of observations to features of shape (batch, d), or "
            "'temporal-distance', which is learned."
        )


def _check_masks(venv: VecEnv) -> None:
    """Refuse masks that a wrapper above `OptionsWrapper` made of the environment's own actions."""
    venv.env_method("set_slots", expect_empty=True)  # as training does, without a warning that no slot is filled
    n = int(venv.action_space.n)  # type: ignore[attr-defined]  # checked to be Discrete
    mask = np.asarray(venv.env_method("action_masks", indices=[0])[0])
    if mask.shape != (n,):
        raise ValueError(
            f"The environment's action_masks() has shape {mask.shape}, and there are {n} actions with the slots for "
            "options: put an ActionMasker of the environment's own actions beneath, OptionsWrapper(ActionMasker(...))."
        )


def _check_nothing_above_changes_observations(venv: VecEnv) -> None:
    """Refuse wrappers above `OptionsWrapper` that change observations: options act on those beneath."""
    seen: spaces.Space[Any] = venv.get_attr("traits", [0])[0].observation_space
    changes = []
    while isinstance(venv, vec_env.VecEnvWrapper) and not isinstance(venv, OptionsVecEnv):
        # The changes of these three are undone before options see observations.
        if not isinstance(venv, (vec_env.VecNormalize, vec_env.VecTransposeImage, VecFrameStack)):
            changes.append((venv.venv.observation_space, venv.observation_space))
        venv = venv.venv
    for beneath, above in [*changes, (seen, venv.observation_space)]:
        if beneath != above:
            raise ValueError(
                f"Between OptionsWrapper and the algorithm observations change from {beneath} to {above}: put what "
                "changes them beneath OptionsWrapper, for instance OptionsWrapper(TransformObservation(env, ...))."
            )


def check_same_slots(venv: VecEnv, eval_env: VecEnv) -> None:
    """Refuse an evaluation environment whose actions differ from those of the training environment."""
    check_wrapped(eval_env, "The environment of EvalCallback")
    actions: tuple[Any, Any] = (venv.action_space, eval_env.action_space)
    if actions[0] != actions[1]:
        raise ValueError(
            f"The environment of EvalCallback has actions {actions[1]}, the training environment {actions[0]}: give "
            "both the same max_options."
        )
