"""Checks of an environment and a model before learning over options."""

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.execution.wrapper import OptionsWrapper


def check_wrapped(venv: VecEnv, whose: str) -> None:
    """Refuse an environment without `OptionsWrapper`."""
    if not all(venv.env_is_wrapped(OptionsWrapper)):
        raise ValueError(
            f"{whose} is not wrapped in OptionsWrapper: use OptionsWrapper(env, max_options=..., gamma=...) or "
            "make_vec_env(..., wrapper_class=OptionsWrapper)."
        )


def check_gamma(model: BaseAlgorithm, venv: VecEnv) -> None:
    """Refuse wrappers whose discount differs from the algorithm's."""
    gamma: float = model.gamma  # type: ignore[attr-defined]  # every algorithm over discrete actions has it
    different = [g for g in (each.gamma for each in venv.get_attr("traits")) if abs(g - gamma) > 1e-12]
    if different:
        raise ValueError(
            f"OptionsWrapper discounts with gamma={different[0]}, {type(model).__name__} with gamma={gamma}: "
            "give both the same."
        )
