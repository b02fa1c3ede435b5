"""What every run of the study is made with; each algorithm's own are the same with and without options."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

GAMMA = 0.97


def _dqn() -> dict[str, Any]:
    return {
        "learning_rate": 1e-3,
        "buffer_size": 50_000,
        "learning_starts": 500,
        "batch_size": 64,
        "train_freq": 4,
        "gradient_steps": 1,
        "target_update_interval": 500,
        "exploration_fraction": 0.5,
        "exploration_final_eps": 0.05,
        "policy_kwargs": {"net_arch": [64, 64]},
    }


def _ppo() -> dict[str, Any]:
    return {
        "learning_rate": 1e-3,
        "n_steps": 256,
        "batch_size": 64,
        "n_epochs": 8,
        "gae_lambda": 0.95,
        "ent_coef": 0.01,
        "policy_kwargs": {"net_arch": [64, 64]},
    }


@dataclass(frozen=True)
class DeepSettings:
    """Settings of the study.

    Attributes:
        dqn: Of ``DQN``.
        ppo: Of ``PPO``.
        n_envs: Parallel environments.
        max_options: Option slots.
        max_new_options: Most options to discover.
        discovery: Other than the defaults of `DiscoverySettings`.
        option: Other than the defaults of `OptionLearningSettings`.
        evaluate_every: Primitive steps between evaluations.
        evaluation_episodes: Episodes of each.
        steps_after: A run ends this many primitive steps after its success rate first was 90 %.
        final_evaluations: How many there are at the end.
    """

    dqn: dict[str, Any] = field(default_factory=_dqn)
    ppo: dict[str, Any] = field(default_factory=_ppo)
    n_envs: int = 1
    max_options: int = 4
    max_new_options: int = 1
    discovery: dict[str, Any] = field(default_factory=dict)
    option: dict[str, Any] = field(default_factory=dict)
    evaluate_every: int = 1000
    evaluation_episodes: int = 20
    steps_after: int = 10_000
    final_evaluations: int = 10
