"""Whether an option does harm: a randomised trial that runs while the agent learns.

McGovern & Barto (2001, §8) leave it to future work to filter out options that do not help. Here every episode draws
for each option, with a generator apart, whether it is withheld. Episodes with it and without it so alternate at random
under the same drift of learning, and their discounted returns G = Σ γᵗ rₜ can be compared at any time:

    close if P(U ≥ u | no effect) ≤ α / (j (j + 1)) at look j = 1, 2, …

U being the one-sided Mann-Whitney statistic for "without it returns are greater" over the last episodes, and a look
taken after every so many withheld episodes. Σ 1/(j (j + 1)) = 1, so that an option without effect is closed with a
probability of at most α, however long the trial goes on, as far as the tail of U is known (`harm`). The draws are
independent of everything before them, so that this needs neither normal nor stationary returns.

Cost: the share of episodes withheld × what the option is worth in an episode, and α.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, Literal, TypeAlias, TypedDict

import numpy as np
from scipy.stats import hypergeom, mannwhitneyu, norm, rankdata

from sb3_options.checked import Field, settings
from sb3_options.execution.interruption import Interruption
from sb3_options.execution.option_step import primitive_of
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.options.option import Option

Verdict: TypeAlias = Literal["harmful", "unreliable"]

Share: TypeAlias = Annotated[float, Field(gt=0, lt=1)]
Episodes: TypeAlias = Annotated[int, Field(ge=1)]


@settings
class TrialSettings:
    """How options are tried.

    Attributes:
        withhold: Share of episodes without an option.
        alpha: Probability of closing an option that makes no difference, all looks together.
        look_every: Withheld episodes between two looks.
        window: Episodes compared: the last so many. What an option did while the agent knew little is no reason to
            keep it, or to close it.
        success_window: The trial is on while at least half of this many last episodes succeeded. Before, nothing is
            compared but luck, and an episode without the option may be long.
        patience: The trial is also on once the option has been there for this many episodes: it may be the reason why
            none succeeds.
    """

    withhold: Share = 0.1
    alpha: Share = 0.05
    look_every: Episodes = 10
    window: Episodes = 400
    success_window: Episodes = 20
    patience: Episodes = 100


class TrialReport(TypedDict):
    """What the info that ends an episode holds as ``info["option_trial"]``.

    Attributes:
        withheld: Of each slot that was tried in the episode, whether it was withheld.
        outcome: Σ γᵗ rₜ of the episode.
    """

    withheld: dict[int, bool]
    outcome: float


class OptionTrial:
    """The trial of one option.

    Args:
        settings: How.
    """

    def __init__(self, settings: TrialSettings) -> None:
        self.settings = settings
        self.looks = 0
        self.p_value = 1.0
        self._episodes: deque[tuple[bool, float]] = deque(maxlen=settings.window)
        self._withheld = 0

    def add(self, *, withheld: bool, outcome: float) -> Verdict | None:
        """Count one episode that drew for this option.

        Args:
            withheld: What it drew.
            outcome: Discounted return Σ γᵗ rₜ of the episode.

        Returns:
            A reason to close the option; None while there is none.
        """
        self._episodes.append((withheld, outcome))
        if withheld:
            self._withheld += 1
            if self._withheld % self.settings.look_every == 0:
                self.looks += 1
                self.p_value = harm(*self._arms())
                if self.p_value <= self.settings.alpha / (self.looks * (self.looks + 1)):
                    return "harmful"
        return None

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "looks": self.looks,
            "p_value": self.p_value,
            "drawn": np.array([withheld for withheld, _ in self._episodes], dtype=bool),
            "outcomes": np.array([outcome for _, outcome in self._episodes], dtype=np.float64),
            "withheld": self._withheld,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self.looks, self.p_value, self._withheld = state["looks"], state["p_value"], state["withheld"]
        self._episodes.clear()
        self._episodes.extend(zip(state["drawn"].tolist(), state["outcomes"].tolist(), strict=True))

    def _arms(self) -> tuple[FloatArray, FloatArray]:
        """Outcomes with the option and without it."""
        outcomes = np.array([outcome for _, outcome in self._episodes])
        withheld = np.array([was_withheld for was_withheld, _ in self._episodes])
        return outcomes[~withheld], outcomes[withheld]


def harm(with_it: FloatArray, without_it: FloatArray) -> float:
    """The probability of a U as great as this one if the option made no difference (Mann & Whitney 1947), one-sided.

    U counts the pairs in which the outcome without the option is greater, and half of those with equal outcomes. Where
    few episodes succeed, or fail, all others have the same outcome, and U is far from normal: one more success is worth
    dozens of pairs. How many of the outcomes above the commonest one, and of those below it, were without the option is
    hypergeometric. With ties this sums over both numbers; given them, U among those above and among those below is
    taken as normal, corrected for ties and continuity, which is rough for fewer than ten episodes without the option.

    Args:
        with_it: Outcomes of episodes with the option, (n,).
        without_it: Outcomes of episodes without it, (m,).

    Returns:
        Small if outcomes without it are greater; 1 where there is nothing to compare, or an outcome is NaN.
    """
    everything = np.concatenate([with_it, without_it])
    if len(with_it) == 0 or len(without_it) == 0 or np.isnan(everything).any() or np.ptp(everything) == 0:
        return 1.0
    values, counts = np.unique(everything, return_counts=True)
    n, m = len(everything), len(without_it)
    if len(values) == n:
        return float(mannwhitneyu(without_it, with_it, alternative="greater").pvalue)
    u = float(rankdata(everything)[len(with_it) :].sum()) - m * (m + 1) / 2
    commonest = values[counts.argmax()]
    n_above, n_below = int((everything > commonest).sum()), int((everything < commonest).sum())
    n_same = n - n_above - n_below
    fewest = max(0, m - n_same - n_below)  # the others are too few for all of those without the option
    above, below = np.ogrid[fewest : min(n_above, m) + 1, : min(n_below, m) + 1]  # of those without the option
    same = m - above - below
    of_these = hypergeom.pmf(above, n, n_above, m) * hypergeom.pmf(below, n - n_above, n_below, m - above)
    worse = n_below - below  # with the option, likewise
    certain = above * (n_same - same + worse) + same * ((n_same - same) / 2 + worse)
    expected = above * (n_above - above) / 2 + below * (n_below - below) / 2
    variance = above * (n_above - above) * _spread(counts[values > commonest])
    variance = variance + below * (n_below - below) * _spread(counts[values < commonest])
    missing = u - certain - expected
    tail = norm.sf((missing - 0.5) / np.sqrt(np.where(variance > 0, variance, 1.0)))
    tail = np.where(variance > 0, tail, missing < 0.25)  # U is a multiple of a half
    return min(float((of_these * tail).sum()), 1.0)


def _spread(ties: IntArray) -> float:
    """Variance of U within a group, as a multiple of the product of the two numbers that are compared.

    Args:
        ties: How often each outcome occurs in it.
    """
    n = int(ties.sum())
    return 0.0 if n < 2 else max((n + 1 - float((ties**3 - ties).sum()) / (n * (n - 1))) / 12, 0.0)


class Withholding:
    """The environment's side of a trial: draws which options an episode does without, and sums what it returns.

    Args:
        seed: Of a generator of its own, so that nothing else draws differently because of a trial.
        gamma: γ per primitive step.
    """

    def __init__(self, seed: Sequence[int], gamma: float) -> None:
        self.random = np.random.default_rng(seed)
        self.gamma = gamma
        self.shares: dict[int, float] = {}
        self.begin(())

    def begin(self, filled: Iterable[int]) -> None:
        """An episode begins with these slots filled."""
        # One draw for every slot that is tried, so that the slots are independent of each other.
        self._drawn = {slot: bool(self.random.random() < self.shares[slot]) for slot in filled if slot in self.shares}
        self._outcome, self._discount = 0.0, 1.0

    def forget(self, slot: int) -> None:
        """Drop what the episode drew for an option that is removed: it says nothing of the next one in its slot."""
        self._drawn.pop(slot, None)

    def withheld(self) -> list[int]:
        """The slots this episode does without."""
        return [slot for slot, drawn in self._drawn.items() if drawn]

    def instead_of(
        self,
        option: Option,
        action: int,
        observation: Any,
        available: Callable[[], BoolArray],
        n_primitive: int,
        rule: Interruption | None,
    ) -> int:
        """The primitive action that the agent takes without an option that it chose.

        Where its values are known: the best in the place of a greedy choice, a random one in the place of an
        exploratory choice. Else one step of the option's own policy.

        Args:
            option: The choice.
            action: The same as augmented action.
            observation: Where it was made.
            available: Gives the mask of the current state, (n_actions,).
            n_primitive: Number of primitive actions.
            rule: Knows the values; None where nobody does.
        """
        if rule is None:
            return primitive_of(option, observation, n_primitive)
        mask = available()
        if rule.falls_behind(action, observation, lambda: mask):
            return int(self.random.choice(np.flatnonzero(mask[:n_primitive])))
        values = np.where(mask, rule.values(observation), -np.inf)
        return int(values[:n_primitive].argmax())

    def note(self, rewards: Iterable[float], *, over: bool) -> dict[str, TrialReport]:
        """Count primitive steps; where the episode is over, what ``info`` says of it if an option was tried."""
        for reward in rewards:
            self._outcome += self._discount * reward
            self._discount *= self.gamma
        return {"option_trial": {"withheld": self._drawn, "outcome": self._outcome}} if over and self._drawn else {}

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "random": self.random.bit_generator.state,
            "shares": dict(self.shares),
            "drawn": dict(self._drawn),
            "episode": (self._outcome, self._discount),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self.random.bit_generator.state = state["random"]
        self.shares, self._drawn = state["shares"], state["drawn"]
        self._outcome, self._discount = state["episode"]
