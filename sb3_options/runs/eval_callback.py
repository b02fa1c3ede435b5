"""Evaluation while training: shown in the progress bar, and ended by an interrupt."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import EvalCallback, ProgressBarCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.atomic import atomic_write
from sb3_options.experience.success import SuccessRule, judged, tell_success
from sb3_options.runs.interrupts import Interrupts

SHOWN_EVERY = 100
"""Decisions of an evaluation between two changes of the progress bar's text."""

BEST = "best_model.zip"
"""File in the run folder."""


class _InterruptedError(Exception):
    """An interrupt came in the middle of an evaluation."""


class WatchedEvalCallback(EvalCallback):
    """SB3's ``EvalCallback`` with progress, interrupts and the run's rule of success; None is the environment's own."""

    remembers_nothing = True  # more than EvalCallback does, from one evaluation to the next

    def __init__(
        self, interrupts: Interrupts, folder: Path, success: SuccessRule | None, eval_env: VecEnv, **kwargs: Any
    ) -> None:
        super().__init__(eval_env, log_path=str(folder), **kwargs)
        self.best = folder / BEST
        self.interrupts = interrupts
        self.success = success
        self._unreported: list[bool] = []
        self._decisions = 0

    def _init_callback(self) -> None:
        super()._init_callback()
        if self.success is not None:
            self.eval_env.env_method("set_slots", record=True)

    def _on_step(self) -> bool:
        self._unreported = []
        before = self.best_mean_reward
        try:
            goes_on = super()._on_step()
        except _InterruptedError:
            self.interrupts.ended = True
            return False
        if self.best_mean_reward > before:
            with atomic_write(self.best) as temporary:
                self.model.save(temporary)
        self._show(f"evaluated: {self.last_mean_reward:.4g}")
        return goes_on

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        # SB3 calls it after every decision of an evaluation.
        with suppress(ValueError):  # the environment reports no truth value, which training says
            if self.success is not None and "trajectory" in locals_["info"]:
                self._tell_success(locals_["info"], self.success)
        super()._log_success_callback(locals_, globals_)
        if self.interrupts.due():
            raise _InterruptedError
        if self._decisions % SHOWN_EVERY == 0:
            episode = min(sum(locals_["episode_counts"]) + 1, self.n_eval_episodes)
            self._show(f"evaluating: episode {episode} of {self.n_eval_episodes}, decision {self._decisions}")
        self._decisions = 0 if locals_["done"] else self._decisions + 1

    def _tell_success(self, info: dict[str, Any], rule: SuccessRule) -> None:
        trajectory, logged = info.pop("trajectory"), self._is_success_buffer
        said = judged(rule, trajectory)
        in_training = bool(self.model.ep_success_buffer)
        tell_success(info, said, trajectory, rule, logged, self._unreported, reported=in_training)
        self._unreported.append(said)

    def _show(self, text: str) -> None:
        for callback in getattr(self.locals.get("callback"), "callbacks", ()):  # learn adds the bar to all others
            if isinstance(callback, ProgressBarCallback):
                callback.pbar.set_description(text)


def eval_callback_class(algo: str) -> type[WatchedEvalCallback]:
    """The one that masks, for an algorithm that is given masks from outside."""
    if algo != "maskableppo":
        return WatchedEvalCallback
    from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback

    return type("WatchedMaskableEvalCallback", (WatchedEvalCallback, MaskableEvalCallback), {})
