"""What every run of the study is made with."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from experiments.deep.arms import BONUS, N_STEP, OPTIONS, STOCK, Arm

GAMMA = 0.97


Sides: TypeAlias = dict[str, dict[str, Any]]
"""Arguments of the algorithm for ``stock`` and for ``options``."""


def _dqn() -> Sides:
    common = {
        "learning_rate": 5e-4,
        "buffer_size": 50_000,
        "learning_starts": 500,
        "batch_size": 64,
        "train_freq": 1,
        "gradient_steps": 4,
        "target_update_interval": 100,
        "exploration_fraction": 0.2,
        "exploration_final_eps": 0.05,
        "policy_kwargs": {"net_arch": [64, 64]},
    }
    return {"stock": common, "options": common}


def _ppo() -> Sides:
    return {
        "stock": {  # by hand: on fresh seeds it was better than what tuning chose
            "learning_rate": 2e-3,
            "n_steps": 32,
            "batch_size": 128,
            "n_epochs": 8,
            "gae_lambda": 0.95,
            "ent_coef": 3e-3,
            "normalize_advantage": False,  # before the first reward it would blow up noise until the policy is stuck
            "policy_kwargs": {"net_arch": [64, 64]},
        },
        "options": {  # but for n_steps as `experiments.deep.tune` chose: docs/results/deep-tuning-ppo-options.json
            "learning_rate": 3.94e-3,
            "n_steps": 32,  # by hand; 64 was chosen before `max_runs` was there
            "batch_size": 64,
            "n_epochs": 16,
            "gae_lambda": 0.8,
            "ent_coef": 3.44e-3,
            "normalize_advantage": False,
            "policy_kwargs": {"net_arch": []},
        },
    }


@dataclass(frozen=True)
class DeepSettings:
    """Settings of the study.

    Attributes:
        dqn: Of ``DQN``, stock and with options.
        ppo: Of ``PPO``, stock and with options.
        max_option_exploration: Of `SubgoalDiscoveryCallback`, by the algorithm's family.
        max_runs: Of `OptionsWrapper`, by the algorithm's family, 0 for no limit; random repeats have none.
        both_as: Whose arguments of the algorithm both sides take; by default each its own.
        n_envs: Parallel environments.
        max_options: Option slots.
        max_new_options: Most options to discover.
        discovery: Other than the defaults of `DiscoverySettings`.
        option: Other than the defaults of `OptionLearningSettings`.
        n_steps: Decisions of the n-step returns, stock and with options.
        brought_exploration: Share of training over which DQN's ε falls where options are brought along, which explore
            themselves; None takes the algorithm's own.
        bonus_weight: Of `IntrinsicRewardCallback`.
        evaluate_every: Primitive steps between evaluations.
        evaluation_episodes: Episodes of each.
        steps_after: A run ends this many primitive steps after it has reached 90 %, by the algorithm's family.
        final_evaluations: How many there are at the end.
    """

    dqn: Sides = field(default_factory=_dqn)
    ppo: Sides = field(default_factory=_ppo)
    max_option_exploration: dict[str, float] = field(default_factory=lambda: {"dqn": 0.5, "ppo": 0.75})
    max_runs: dict[str, int] = field(default_factory=lambda: {"dqn": 0, "ppo": 5})
    both_as: Literal["", "stock", "options"] = ""
    n_envs: int = 8
    max_options: int = 4
    max_new_options: int = 2
    discovery: dict[str, Any] = field(default_factory=lambda: {"decay": 0.75, "min_positive": 5, "search_growth": 0.0})
    option: dict[str, Any] = field(default_factory=lambda: {"grow": True})
    n_steps: int = 10
    brought_exploration: float | None = None
    bonus_weight: float = 0.1
    evaluate_every: int = 1000
    evaluation_episodes: int = 20
    steps_after: dict[str, int] = field(default_factory=lambda: {"dqn": 6_000, "ppo": 30_000})
    final_evaluations: int = 10

    def of(self, algo: str, arm: Arm) -> dict[str, Any]:
        """What the runs of one arm of an algorithm depend on."""
        own = {"algorithm": self.arguments(algo, arm), "steps_after": self.steps_after[family(algo)]}
        common = ["n_envs", "evaluate_every", "evaluation_episodes", "final_evaluations"]
        if arm not in STOCK:
            common += ["max_options", "max_new_options", "discovery", "option", "callback"]
            own["max_option_exploration"] = self.max_option_exploration[family(algo)]
        if arm in OPTIONS:
            own["max_runs"] = self.max_runs[family(algo)]
        if arm in N_STEP:
            own["n_steps"] = self.n_steps
        if arm in OPTIONS and family(algo) == "dqn" and self.brought_exploration is not None:
            own["brought_exploration"] = self.brought_exploration
        if arm in BONUS:
            own["bonus_weight"] = self.bonus_weight
        return {**own, **{name: value for name, value in dataclasses.asdict(self).items() if name in common}}

    def arguments(self, algo: str, arm: Arm) -> dict[str, Any]:
        """Of the algorithm itself; random repeats take those of options."""
        sides: Sides = getattr(self, family(algo))
        return sides[self.both_as or ("stock" if arm in STOCK else "options")]

    def for_brought_options(self) -> DeepSettings:
        """Those of training with options that are brought along."""
        if self.brought_exploration is None:
            return self
        options = {**self.dqn["options"], "exploration_fraction": self.brought_exploration}
        return dataclasses.replace(self, dqn={**self.dqn, "options": options})

    def switched(self) -> list[str]:
        """The flags of what is not as by default, as far as the study varies it."""
        flags = [f"--settings.both-as {self.both_as}"] if self.both_as else []
        for name in ("n_steps", "brought_exploration", "bonus_weight"):
            if getattr(self, name) != getattr(DeepSettings(), name):
                flags.append(f"--settings.{name.replace('_', '-')} {getattr(self, name)}")
        for group in ("max_option_exploration", "max_runs"):
            for name, value in getattr(self, group).items():
                if value != getattr(DeepSettings(), group)[name]:
                    flags.append(f"--settings.{group.replace('_', '-')}.{name} {value}")
        return flags


def family(algo: str) -> str:
    """``ppo`` or ``dqn``, whose settings an algorithm has."""
    return "ppo" if algo.startswith("ppo") else "dqn"
