"""A policy's warm start from demonstrations, over primitives and options."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from experiments.demonstrations.segmentation import decisions
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.experience.observations import concatenate, take
from sb3_options.experience.trajectories import Trajectory

UPDATES = 1000
"""Gradient steps before the first step of training."""

BATCH_SIZE = 256

LEARNING_RATE = 1e-3


class Cloning(BaseCallback):
    """Begins MaskablePPO with the decisions of demonstrations, by maximum likelihood (Pomerleau 1991).

    The value function is left alone: fitted to successes only, it takes every failure for a surprise, and the first
    updates undo what was cloned. Put this callback after the one that discovers.

    Args:
        discovery: Whose options are decisions, too.
        demonstrations: Successful ones.
        seed: Of the batches.
    """

    def __init__(self, discovery: SubgoalDiscoveryCallback, demonstrations: Sequence[Trajectory], seed: int) -> None:
        super().__init__()
        self.discovery = discovery
        self.demonstrations = demonstrations
        self.generator = torch.Generator().manual_seed(seed)

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        policy: Any = self.model.policy
        bank = self.discovery.bank
        made = [decisions(each, bank) for each in self.demonstrations]
        actions, masks = (np.concatenate(part) for part in zip(*made, strict=True))
        observations: Any = concatenate([take(each.states, each.visits[:-1]) for each in self.demonstrations])
        optimizer = torch.optim.Adam(policy.parameters(), LEARNING_RATE)
        policy.set_training_mode(True)
        for _ in range(UPDATES):
            rows = torch.randint(len(actions), (BATCH_SIZE,), generator=self.generator).numpy()
            batch, _ = policy.obs_to_tensor(observations[rows])
            chosen = torch.as_tensor(actions[rows], device=policy.device)
            _, log_prob, _ = policy.evaluate_actions(batch, chosen, masks[rows])
            optimizer.zero_grad()
            (-log_prob.mean()).backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
            optimizer.step()
