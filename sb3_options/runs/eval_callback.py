"""Evaluation while training: shown in the progress bar, and ended by an interrupt."""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, ProgressBarCallback

from sb3_options.atomic import atomic_write
from sb3_options.experience.success import SuccessRule, judged, tell_success
from sb3_options.runs.interrupts import Interrupts
from sb3_options.runs.logs import Tolerance

SHOWN_EVERY = 100
"""Decisions of an evaluation between two changes of what the progress bar says."""


BEST, EVALUATIONS = "best_model.zip", "evaluations.npz"
"""Files in the run folder."""


class _InterruptedError(Exception):
    """An interrupt came in the middle of an evaluation."""


class WatchedEvalCallback(EvalCallback):
    """SB3's ``EvalCallback``, whose evaluations the progress bar shows, and which an interrupt ends with training.

    It writes ``evaluations.npz`` and ``best_model.zip`` whole or not at all; a full disk ends no training. It logs
    success by the run's rule, as training and ``evaluate`` do.

    Args:
        interrupts: Notes them.
        folder: Where to write.
        success: The rule; None for what the environment reports.
        *args: Of ``EvalCallback``.
        **kwargs: Likewise.
    """

    remembers_nothing = True  # more than EvalCallback does, from one evaluation to the next

    def __init__(
        self, interrupts: Interrupts, folder: Path, success: SuccessRule | None, *args: Any, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs | {"callback_on_new_best": _SaveBest(folder / BEST)})
        self.interrupts, self.success = interrupts, success
        self._unreported: list[bool] = []
        self.log_path: Any = io.BytesIO()  # SB3's file, rewritten with every evaluation
        self._file = folder / EVALUATIONS
        self._write = Tolerance(self._file).tolerant(self._write_evaluations)
        self._decisions = 0

    def _init_callback(self) -> None:
        self.log_path, file = None, self.log_path  # SB3 would make its folder
        super()._init_callback()
        self.log_path = file
        if self.success is not None:
            self.eval_env.env_method("record_trajectories", True)

    def _on_step(self) -> bool:
        self._unreported = []
        self.log_path.seek(0)
        self.log_path.truncate()
        try:
            goes_on = super()._on_step()
        except _InterruptedError:
            self.interrupts.ended = True
            return False
        if content := self.log_path.getvalue():
            self._write(content)
        self._show(f"evaluated: {self.last_mean_reward:.4g}")
        return goes_on

    def _write_evaluations(self, content: bytes) -> None:
        with atomic_write(self._file) as temporary:
            temporary.write_bytes(content)

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        # SB3 calls it after every decision of an evaluation.
        with suppress(ValueError):  # what the environment reports is no truth value, which training says
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


class _SaveBest(BaseCallback):
    """Saves the model."""

    remembers_nothing = True

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._save = Tolerance(path).tolerant(lambda: self.model.save(path))

    def _on_step(self) -> bool:
        self._save()
        return True


def eval_callback_class(algo: str) -> type[WatchedEvalCallback]:
    """The one that masks, for an algorithm that is given masks from outside."""
    if algo != "maskableppo":
        return WatchedEvalCallback
    from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback

    return type("WatchedMaskableEvalCallback", (WatchedEvalCallback, MaskableEvalCallback), {})
