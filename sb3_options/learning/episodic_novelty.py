"""Novelty within an episode: NovelD and E3B, the bonuses that the field compares with in MiniGrid."""

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from sb3_options.density.arrays import short_key
from sb3_options.experience.observations import FloatArray, flatten
from sb3_options.learning.novelty import N_FEATURES, NetworkNovelty, RandomNetworkDistillation, Steps, as_array, network

ALPHA = 0.5  # share of the novelty of the observation before that `NovelD` subtracts (Zhang et al. 2021, α)
DECIMALS = 5  # to which observations are rounded before they are compared: normalisation leaves rounding errors
RIDGE = 0.1  # multiple of the identity that `EllipticalBonus` begins an episode with (Henaff et al. 2022, λ)


class NovelD(RandomNetworkDistillation):
    """Gain of novelty, the first time that an observation is visited in its episode (Zhang et al. 2021, eq. 2).

    b = max(nov(s') − α nov(s), 0) · 1{N_episode(s') = 1}. Here nov is the root of the error of random network
    distillation, so a bonus is given on the border between known and new observations. Observations that are equal to
    ``DECIMALS`` decimals are one. In continuous spaces hardly any are, so nearly every visit is a first one.
    """

    STATE = ("seen",)

    def __init__(self, size: int, seed: int = 0) -> None:
        super().__init__(size, seed)
        self.seen: dict[int, set[bytes]] = {}  # observations of the present episode, by environment

    def bonuses(self, steps: Steps) -> FloatArray:
        """Return the bonus of each primitive step, (n,), and learn from it."""
        left, arrived = flatten(steps.before), flatten(steps.after)
        self.statistics.update(arrived)
        with torch.no_grad():
            before = as_array(self.errors(self.normalized(left)))
        errors = self.errors(self.normalized(arrived))
        bonuses = np.maximum(np.sqrt(as_array(errors)) - ALPHA * np.sqrt(before), 0.0)
        self.learn(errors)
        each = zip(steps.envs.tolist(), steps.begins.tolist(), keys_of(left), keys_of(arrived), strict=True)
        for i, (env, begins, here, there) in enumerate(each):
            if begins or env not in self.seen:
                self.seen[env] = {here}
            bonuses[i] *= there not in self.seen[env]
            self.seen[env].add(there)
        return bonuses


def keys_of(rows: FloatArray) -> list[bytes]:
    """Return a key for each flat observation of a batch, equal for those that are one."""
    return [short_key(row.tobytes()) for row in rows.round(DECIMALS) + 0.0]  # + 0.0: −0 is 0


class EllipticalBonus(NetworkNovelty):
    """E3B: how little the features of an observation resemble those of its episode so far (Henaff et al. 2022).

    b = ψ(s')ᵀ C⁻¹ ψ(s') with C = λ I + Σ ψ ψᵀ over the episode's earlier observations, the first one included (eq. 2).
    The encoder ψ learns to predict the primitive action from ψ(s) and ψ(s').
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
        left, arrived = self.normalized(flatten(steps.before)), self.normalized(rows)
        encoded = self.encoder(left), self.encoder(arrived)
        here, there = map(as_array, encoded)
        predicted = self.inverse_dynamics(torch.cat(encoded, dim=1))
        actions = torch.as_tensor(steps.actions, dtype=torch.int64)
        self.learn(functional.cross_entropy(predicted, actions, reduction="none"))
        bonuses = np.empty(len(rows))
        for i, (env, begins) in enumerate(zip(steps.envs.tolist(), steps.begins.tolist(), strict=True)):
            if begins or env not in self.inverses:
                self.inverses[env] = np.eye(N_FEATURES) / RIDGE
                _include(here[i], self.inverses[env])
            bonuses[i] = _include(there[i], self.inverses[env])
        return bonuses


def _include(feature: FloatArray, inverse: FloatArray) -> float:
    """Return ψᵀ C⁻¹ ψ, and add ψ ψᵀ to C (Sherman & Morrison)."""
    change = inverse @ feature
    bonus = float(feature @ change)
    inverse -= np.outer(change, change) / (1.0 + bonus)
    return bonus
