"""Whether an option does harm: a randomised trial that runs while the agent learns.

McGovern & Barto (2001, §8) leave it to future work to filter out options that do not help. Here every episode draws
for each option, with a generator apart, whether it is withheld. Episodes with it and without it so alternate at random
under the same drift of learning, and their discounted returns G = Σ γᵗ rₜ can be compared at any time:

    close if P(U ≥ u | no effect) ≤ α / (j (j + 1)) at look j = 1, 2, …

U being the one-sided Mann-Whitney statistic for "without it returns are greater" over the last episodes, and a look
taken after every so many withheld episodes. Σ 1/(j (j + 1)) = 1, so that an option without effect is closed with a
probability of at most α, however long the trial goes on. Because the draws are independent of everything before them,
this needs neither normal nor stationary returns.

Cost: the share of episodes withheld × what the option is worth in an episode, and α.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.stats import mannwhitneyu

from sb3_options.experience.observations import FloatArray

Verdict: TypeAlias = Literal["harmful", "useless"]


@dataclass(frozen=True)
class TrialSettings:
    """How options are tried.

    Attributes:
        withhold: Share of episodes without an option, in (0, 1).
        alpha: Probability of closing an option that makes no difference, all looks together, in (0, 1).
        look_every: Withheld episodes between two looks.
        window: Episodes compared: the last so many. What an option did while the agent knew little is no reason to
            keep it, or to close it.
        success_window: The trial is on while at least half of this many last episodes succeeded: before, nothing is
            compared but luck, and an episode without the option may be long …
        patience: … or once the option has been there for this many episodes: it may be the reason why none succeeds.
        close_useless: Whether an option that is hardly run is closed as well, to make room for another.
        useless_share: It is useless if it ran in fewer than this share of the episodes of a full window it might have.
    """

    withhold: float = 0.1
    alpha: float = 0.05
    look_every: int = 10
    window: int = 400
    success_window: int = 20
    patience: int = 100
    close_useless: bool = False
    useless_share: float = 0.02

    def __post_init__(self) -> None:
        """Refuse values out of range, by name."""
        for name in ("withhold", "alpha"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be in (0, 1), got {getattr(self, name)}.")
        for name in ("look_every", "window", "success_window", "patience"):
            if getattr(self, name) < 1 or getattr(self, name) % 1:
                raise ValueError(f"{name} must be a whole number of episodes, at least 1, got {getattr(self, name)}.")
        if not 0.0 <= self.useless_share <= 1.0:
            raise ValueError(f"useless_share must be in [0, 1], got {self.useless_share}.")


class OptionTrial:
    """The trial of one option.

    Args:
        settings: How.
    """

    def __init__(self, settings: TrialSettings) -> None:
        self.settings = settings
        self.looks = 0
        self.p_value = 1.0
        self._episodes: deque[tuple[bool, float, bool]] = deque(maxlen=settings.window)
        self._withheld = 0

    def add(self, *, withheld: bool, outcome: float, used: bool) -> Verdict | None:
        """Count one episode that drew for this option.

        Args:
            withheld: What it drew.
            outcome: Discounted return Σ γᵗ rₜ of the episode.
            used: Whether the option ran in it.

        Returns:
            A reason to close the option; None while there is none.
        """
        self._episodes.append((withheld, outcome, used))
        if withheld:
            self._withheld += 1
            if self._withheld % self.settings.look_every == 0:
                self.looks += 1
                self.p_value = harm(*self._arms())
                if self.p_value <= self.settings.alpha / (self.looks * (self.looks + 1)):
                    return "harmful"
        if self.settings.close_useless and len(self._episodes) == self.settings.window:
            used_in = [was_used for was_withheld, _, was_used in self._episodes if not was_withheld]
            if np.mean(used_in) < self.settings.useless_share:
                return "useless"
        return None

    def _arms(self) -> tuple[FloatArray, FloatArray]:
        """Outcomes with the option and without it."""
        outcomes = np.array([outcome for _, outcome, _ in self._episodes])
        withheld = np.array([was_withheld for was_withheld, _, _ in self._episodes])
        return outcomes[~withheld], outcomes[withheld]


def harm(with_it: FloatArray, without_it: FloatArray) -> float:
    """The probability of a U as great as this one if the option made no difference (Mann & Whitney 1947), one-sided.

    Args:
        with_it: Outcomes of episodes with the option, (n,).
        without_it: Outcomes of episodes without it, (m,).

    Returns:
        Small if outcomes without it are greater; 1 where there is nothing to compare.
    """
    if len(with_it) == 0 or len(without_it) == 0 or np.ptp(np.concatenate([with_it, without_it])) == 0:
        return 1.0
    return float(mannwhitneyu(without_it, with_it, alternative="greater").pvalue)
