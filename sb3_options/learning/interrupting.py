"""Giving the environments the values by which their options are interrupted."""

from __future__ import annotations

from collections.abc import Sequence

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.learning.value_snapshot import interrupt_options

REFRESH = 500
"""Primitive steps after which the environments get newer values."""


class Interrupter:
    """Keeps the values in the environments at most `REFRESH` primitive steps behind the model's.

    Args:
        model: Being trained.
        venv: Its environment, where an option is interrupted if it was the best choice where it began.
        eval_envs: Where choices are greedy, and every option is interrupted.
    """

    def __init__(self, model: BaseAlgorithm, venv: VecEnv, eval_envs: Sequence[VecEnv]) -> None:
        self.model, self.venv, self.eval_envs = model, venv, eval_envs
        self._refreshed: int | None = None

    def refresh(self, *, at_once: bool = False) -> None:
        """Send the model's values, if those that were sent are too old."""
        now = self.model.num_timesteps
        if not at_once and self._refreshed is not None and now - self._refreshed < REFRESH:
            return
        self._refreshed = now
        interrupt_options(self.model, self.venv, every_choice=False)
        for eval_env in self.eval_envs:
            interrupt_options(self.model, eval_env)
