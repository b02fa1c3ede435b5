"""Evaluation while training: shown in the progress bar, and ended by an interrupt."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import EvalCallback, ProgressBarCallback

from sb3_options.runs.interrupts import Interrupts

SHOWN_EVERY = 100
"""Decisions of an evaluation between two changes of what the progress bar says."""


class _InterruptedError(Exception):
    """An interrupt came in the middle of an evaluation."""


class WatchedEvalCallback(EvalCallback):
    """SB3's ``EvalCallback``, whose evaluations the progress bar shows, and which an interrupt ends with training.

    Args:
        interrupts: Notes them.
        *args: Of ``EvalCallback``.
        **kwargs: Likewise.
    """

    remembers_nothing = True  # more than EvalCallback does, from one evaluation to the next

    def __init__(self, interrupts: Interrupts, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.interrupts = interrupts
        self._decisions = 0

    def _on_step(self) -> bool:
        try:
            goes_on = super()._on_step()
        except _InterruptedError:
            return False
        self._show(f"evaluated: {self.last_mean_reward:.4g}")
        return goes_on

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        # SB3 calls it after every decision of an evaluation.
        super()._log_success_callback(locals_, globals_)
        if self.interrupts.noted:
            raise _InterruptedError
        if self._decisions % SHOWN_EVERY == 0:
            episode = min(sum(locals_["episode_counts"]) + 1, self.n_eval_episodes)
            self._show(f"evaluating: episode {episode} of {self.n_eval_episodes}, decision {self._decisions}")
        self._decisions = 0 if locals_["done"] else self._decisions + 1

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
