"""What every run of the study is made with."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

GAMMA = 0.97


def _dqn() -> dict[str, Any]:
    return {
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


def _ppo() -> dict[str, Any]:
    return {
        "learning_rate": 2e-3,
        "n_steps": 32,
        "batch_size": 128,
        "n_epochs": 8,
        "gae_lambda": 0.95,
        "ent_coef": 0.003,
        "normalize_advantage": False,  # before the first reward it would blow up noise until the policy is stuck
        "policy_kwargs": {"net_arch": [64, 64]},
    }


@dataclass(frozen=True)
class DeepSettings:
    """Settings of the study.

    Attributes:
        dqn: Of ``DQN``, with and without options.
        ppo: Of ``PPO``, with and without options.
        n_envs: Parallel environments.
        max_options: Option slots.
        max_new_options: Most options to discover.
        discovery: Other than the defaults of `DiscoverySettings`.
        option: Other than the defaults of `OptionLearningSettings`.
        callback: Switches of `SubgoalDiscoveryCallback`: ``teach_head``, ``interruption``.
        buffer: Switches of `OptionReplayBuffer`: ``intra_option``, ``macro_q``.
        evaluate_every: Primitive steps between evaluations.
        evaluation_episodes: Episodes of each.
        steps_after: A run ends this many primitive steps after it has reached 90 %, by the algorithm's family.
        final_evaluations: How many there are at the end.
    """

    dqn: dict[str, Any] = field(default_factory=_dqn)
    ppo: dict[str, Any] = field(default_factory=_ppo)
    n_envs: int = 8
    max_options: int = 4
    max_new_options: int = 2
    discovery: dict[str, Any] = field(default_factory=lambda: {"decay": 0.75, "min_positive": 5})
    option: dict[str, Any] = field(default_factory=lambda: {"grow": True})
    callback: dict[str, Any] = field(default_factory=lambda: {"teach_head": False, "interruption": True})
    buffer: dict[str, Any] = field(default_factory=lambda: {"intra_option": False})
    evaluate_every: int = 1000
    evaluation_episodes: int = 20
    steps_after: dict[str, int] = field(default_factory=lambda: {"dqn": 6_000, "ppo": 12_000})
    final_evaluations: int = 10

    def of(self, algo: str) -> dict[str, Any]:
        """What a run of an algorithm depends on."""
        others = "dqn" if family(algo) == "ppo" else "ppo"
        return {name: value for name, value in dataclasses.asdict(self).items() if not name.startswith(others)}

    def switched(self) -> list[str]:
        """The flags of the switches that are not as by default."""
        flags = []
        for group, default in (("callback", DeepSettings().callback), ("buffer", DeepSettings().buffer)):
            for name, value in getattr(self, group).items():
                if value != default.get(name):
                    flags.append(f"--settings.{group}.{'' if value else 'no-'}{name.replace('_', '-')}")
        return flags


def family(algo: str) -> str:
    """``ppo`` or ``dqn``, whose settings an algorithm has."""
    return "ppo" if algo.startswith("ppo") else "dqn"
