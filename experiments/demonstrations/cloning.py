"""Behaviour cloning over primitives and options: a policy's warm start from demonstrations (Pomerleau 1991)."""

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

STEPS_PER_UPDATE = 40
"""Primitive steps of training for a gradient step of rehearsal, about as many as PPO makes itself."""

BATCH_SIZE = 256

LEARNING_RATE = 1e-3

ENTROPY = 0.01
"""Coefficient of the entropy."""


RECENT = 100
"""Episodes, of which half must succeed for demonstrations to be rehearsed no more."""


class Cloning(BaseCallback):
    """Begins MaskablePPO with the decisions of demonstrations, and rehearses them until it succeeds itself.

    The value function is left alone: fitted to successes only, it takes every failure for a surprise, and the first
    updates undo what was cloned. Put it after the callback that discovers.

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
        self.taught_at: int | None = None

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        policy: Any = self.model.policy
        if self.taught_at is None:
            self.taught_at = 0
            self.fit(torch.optim.Adam(policy.parameters(), LEARNING_RATE), UPDATES)
        elif sum(each.success for each in self.discovery.history[-RECENT:]) < RECENT / 2:
            updates = (self.model.num_timesteps - self.taught_at) // STEPS_PER_UPDATE
            self.taught_at += updates * STEPS_PER_UPDATE
            self.fit(policy.optimizer, updates)  # after Rajeswaran et al. 2018

    def fit(self, optimizer: torch.optim.Optimizer, updates: int) -> None:
        """Fit the policy to the decisions of the demonstrations, by maximum likelihood."""
        policy: Any = self.model.policy
        made = [decisions(each, self.discovery.bank) for each in self.demonstrations]
        actions = np.concatenate([actions for actions, _ in made])
        masks = np.concatenate([masks for _, masks in made])
        observations: Any = concatenate([take(each.states, each.visits[:-1]) for each in self.demonstrations])
        policy.set_training_mode(True)
        for _ in range(updates):
            rows = torch.randint(len(actions), (BATCH_SIZE,), generator=self.generator).numpy()
            batch, _ = policy.obs_to_tensor(observations[rows])
            chosen = torch.as_tensor(actions[rows], device=policy.device)
            _, log_prob, entropy = policy.evaluate_actions(batch, chosen, masks[rows])
            loss = -log_prob.mean() - ENTROPY * entropy.mean()
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
            optimizer.step()
