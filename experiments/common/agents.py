"""Agents that live through trials: Q-learning over options in one environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options import MacroQ, OptionsWrapper

NO_LIMIT = 10**12
"""Primitive steps: trials end a run, not steps."""


class Trials(BaseCallback):
    """Ends training after some trials.

    Args:
        n_trials: How many.
        until: Asked after each trial; True ends training too.

    Attributes:
        infos: The last info of each trial, without what an earlier callback took out of it.
    """

    def __init__(self, n_trials: int, until: Callable[[], bool]) -> None:
        super().__init__()
        self.n_trials, self.until = n_trials, until
        self.infos: list[dict[str, Any]] = []

    @property
    def episodes(self) -> list[dict[str, Any]]:
        """What the monitor says of each trial."""
        return [info["episode"] for info in self.infos]

    @property
    def lengths(self) -> list[int]:
        """Primitive steps of each trial."""
        return [int(episode["l"]) for episode in self.episodes]

    def _on_step(self) -> bool:
        if not self.locals["dones"][0]:
            return True
        self.infos.append(self.locals["infos"][0])
        return len(self.infos) < self.n_trials and not self.until()


def live(
    agent: MacroQ, n_trials: int, callback: BaseCallback | None = None, until: Callable[[], bool] = lambda: False
) -> Trials:
    """Let an agent learn for some trials, going on where it was.

    Args:
        agent: Who.
        n_trials: How many trials; none if not positive.
        callback: Called before the trials are counted.
        until: Asked after each trial; True ends it too.

    Returns:
        What the trials were like.
    """
    trials = Trials(n_trials, until)
    if n_trials > 0:
        both = trials if callback is None else CallbackList([callback, trials])
        agent.learn(NO_LIMIT, callback=both, log_interval=None, reset_num_timesteps=False)
    return trials


def wrapper_of(agent: MacroQ) -> OptionsWrapper:
    """The environment with its option bank."""
    return cast("OptionsWrapper", cast("DummyVecEnv", agent.get_env()).envs[0])
