"""The randomised trials of all options, over all training environments."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_options.execution.trials import OptionTrial, TrialReport, TrialSettings, Verdict

TRIAL_SEED = 0x7121A1
"""Mixed into the seed, so that the draws of trials are independent of everything else that is seeded."""


class OptionTrials:
    """One trial for each option, over all training environments.

    Args:
        venv: Where episodes run. In evaluation environments nothing is withheld.
        settings: Of every trial.
        seed: Of the draws.
    """

    def __init__(self, venv: VecEnv, settings: TrialSettings, seed: int) -> None:
        self.venv, self.settings, self.seed = venv, settings, seed
        self.trials: dict[int, OptionTrial] = {}
        self._ages: dict[int, int] = {}
        self._succeeded: deque[bool] = deque(maxlen=settings.success_window)
        self._shares: dict[int, float] = {}

    def episode_ended(
        self, report: TrialReport | None, *, success: bool, filled: Iterable[int]
    ) -> list[tuple[int, Verdict]]:
        """Add one episode to the trials of its options.

        Args:
            report: Of `OptionsWrapper`; None if no option was tried in the episode.
            success: Whether it succeeded.
            filled: The slots that hold an option now.

        Returns:
            The slots to close, and why.
        """
        self._succeeded.append(success)
        filled = list(filled)
        for slot in set(self._ages) - set(filled):
            self.forget(slot)
        closing: list[tuple[int, Verdict]] = []
        for slot in filled:
            self._ages[slot] = self._ages.get(slot, 0) + 1
            if report is None or slot not in report["withheld"]:
                continue
            trial = self.trials.setdefault(slot, OptionTrial(self.settings))
            verdict = trial.add(withheld=report["withheld"][slot], outcome=report["outcome"])
            if verdict is not None:
                closing.append((slot, verdict))
        self._send({slot: self.settings.withhold for slot in filled if self._is_on(slot)})
        return closing

    def forget(self, slot: int) -> None:
        """End the trial of a slot whose option was replaced or removed."""
        self.trials.pop(slot, None)
        self._ages.pop(slot, None)

    def end(self) -> None:
        """Stop withholding options."""
        self._shares = {}
        self.venv.env_method("end_trials")

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "trials": {slot: trial.get_state() for slot, trial in self.trials.items()},
            "ages": dict(self._ages),
            "succeeded": list(self._succeeded),
            "shares": dict(self._shares),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave; the environments have their own part."""
        self.trials = {slot: OptionTrial(self.settings) for slot in state["trials"]}
        for slot, trial in self.trials.items():
            trial.set_state(state["trials"][slot])
        self._ages, self._shares = state["ages"], state["shares"]
        self._succeeded.clear()
        self._succeeded.extend(state["succeeded"])

    def _is_on(self, slot: int) -> bool:
        knows = len(self._succeeded) == self.settings.success_window and 2 * sum(self._succeeded) >= len(
            self._succeeded
        )
        return knows or self._ages[slot] >= self.settings.patience

    def _send(self, shares: dict[int, float]) -> None:
        if shares == self._shares:
            return
        self._shares = shares
        for i in range(self.venv.num_envs):
            self.venv.env_method("withhold_options", shares, [self.seed, TRIAL_SEED, i], indices=[i])
