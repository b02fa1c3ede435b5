"""Novelty within an episode: NovelD and E3B, the bonuses that the field compares with in MiniGrid."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from sb3_options.experience.observations import FloatArray, flatten, keys_of
from sb3_options.learning.novelty import N_FEATURES, NetworkNovelty, RandomNetworkDistillation, Steps, network

ALPHA = 0.5
"""Share of the novelty of the observation before that `NovelD` subtracts (Zhang et al. 2021, α)."""

RIDGE = 0.1
"""Multiple of the identity that `EllipticalBonus` begins an episode with (Henaff et al. 2022, λ)."""


class NovelD(RandomNetworkDistillation):
    """Gain of novelty, the first time that an observation is visited in its episode (Zhang et al. 2021, eq. 2).

    b = max(nov(s') − α nov(s), 0) · 1{N_episode(s') = 1}. Here nov is the root of the error of random network
    distillation, so a bonus is given on the border between known and new observations.
    """

    STATE = ("seen",)

    def __init__(self, size: int, seed: int = 0) -> None:
        super().__init__(size, seed)
        self.seen: dict[int, set[bytes]] = {}  # observations of the present episode, by environment

    def bonuses(self, steps: Steps) -> FloatArray:
        """Return the bonus of each primitive step, (n,), and learn from it."""
        rows = flatten(steps.after)
        self.statistics.update(rows)
        normalized = self.normalized(rows)
        before = np.sqrt(self.errors(self.normalized(flatten(steps.before))))
        bonuses = np.maximum(np.sqrt(self.errors(normalized)) - ALPHA * before, 0.0)
        self.learn(normalized)
        each = zip(steps.envs.tolist(), keys_of(steps.before), keys_of(steps.after), steps.ends.tolist(), strict=True)
        for i, (env, left, arrived, ended) in enumerate(each):
            seen = self.seen.setdefault(env, {left})
            bonuses[i] *= arrived not in seen
            seen.add(arrived)
            if ended:
                del self.seen[env]
        return bonuses


class EllipticalBonus(NetworkNovelty):
    """E3B: how little the features of an observation resemble those of its episode so far (Henaff et al. 2022).

    b = ψ(s')ᵀ C⁻¹ ψ(s') with C = λ I + Σ ψ ψᵀ over the observations that the episode arrived in before (eq. 2). The
    encoder ψ learns to predict the primitive action from ψ(s) and ψ(s').
    """

    STATE = ("encoder", "inverse_dynamics", "inverses")

    def __init__(self, size: int, n_actions: int, seed: int = 0) -> None:
        with torch.random.fork_rng(devices=[]):  # the bonus must not change the model's own draws
            torch.manual_seed(seed)
            self.encoder = network(size, N_FEATURES, n_hidden=1)
            self.inverse_dynamics = network(2 * N_FEATURES, n_actions, n_hidden=1)
        super().__init__(size, nn.ModuleList([self.encoder, self.inverse_dynamics]))
        self.inverses: dict[int, FloatArray] = {}  # C⁻¹ of the present episode, by environment

    def bonuses(self, steps: Steps) -> FloatArray:
        """Return the bonus of each primitive step, (n,), and learn from it."""
        rows = flatten(steps.after)
        self.statistics.update(rows)
        normalized = self.normalized(rows)
        with torch.no_grad():
            features = self.encoder(normalized).double().numpy()
        self.learn(self.normalized(flatten(steps.before)), torch.as_tensor(steps.actions), normalized)
        bonuses = np.empty(len(rows))
        each = zip(steps.envs.tolist(), features, steps.ends.tolist(), strict=True)
        for i, (env, feature, ended) in enumerate(each):
            inverse = self.inverses.setdefault(env, np.eye(N_FEATURES) / RIDGE)
            change = inverse @ feature
            bonuses[i] = feature @ change
            inverse -= np.outer(change, change) / (1.0 + bonuses[i])  # Sherman and Morrison
            if ended:
                del self.inverses[env]
        return bonuses

    def loss_of(self, *visited: torch.Tensor) -> torch.Tensor:
        """Return the cross-entropy of the predicted actions."""
        before, actions, after = visited
        features = torch.cat([self.encoder(before), self.encoder(after)], dim=1)
        return functional.cross_entropy(self.inverse_dynamics(features), actions)
