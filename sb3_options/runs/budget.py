"""What a run may use up: its primitive steps, and the memory of the machine."""

from __future__ import annotations

import math

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_options.runs.config import OFF_POLICY, TrainConfig

TOLERATED = 0.05
"""Share of a budget by which whole rollouts may exceed it without a word."""


class KeepToBudget(BaseCallback):
    """Ends off-policy training with its budget, where SB3 ends it after a whole rollout of ``train_freq`` decisions.

    The last rollout is shortened to what is left, and learned from. If options in it take longer than that, training
    ends in the middle of it. Algorithms without ``train_freq`` are let be: there `PrimitiveStepsCallback` does it.
    """

    remembers_nothing = True  # a checkpoint is never of the last rollout

    def _on_training_start(self) -> None:
        self._stock = getattr(self.model, "train_freq", None)
        self._shorten()

    def _on_rollout_end(self) -> None:
        self._shorten()

    def _shorten(self) -> None:
        if isinstance(self._stock, TrainFreq) and self._stock.unit == TrainFrequencyUnit.STEP:
            left = math.ceil((self.model._total_timesteps - self.model.num_timesteps) / self.training_env.num_envs)
            self.model.train_freq = self._stock._replace(  # type: ignore[attr-defined]  # of off-policy algorithms
                frequency=max(min(self._stock.frequency, left), 1)
            )

    def _on_step(self) -> bool:
        within = self.model.num_timesteps < self.model._total_timesteps
        frequency = self.locals.get("train_freq")
        return within or frequency is None or bool(self.locals["num_collected_steps"] >= frequency.frequency)

    def _on_training_end(self) -> None:
        if self._stock is not None:
            self.model.train_freq = self._stock  # type: ignore[attr-defined]  # likewise


def rounded_up(config: TrainConfig) -> str:
    """What to say of a budget that whole rollouts make larger by more than `TOLERATED`; nothing of any other."""
    if config.algo in OFF_POLICY:
        return ""
    n_steps = config.algo_kwargs["n_steps"]
    rollout = n_steps * config.n_envs
    taken = math.ceil(config.n_timesteps / rollout) * rollout
    if taken <= (1.0 + TOLERATED) * config.n_timesteps:
        return ""
    return (
        f"--n-timesteps {config.n_timesteps:,} is rounded up to {taken:,}, for {config.algo} learns from whole "
        f"rollouts: --n-steps {n_steps:,} times --n-envs {config.n_envs:,}. Smaller ones come closer."
    )
