"""A policy's warm start from demonstrations, over primitives and options, and imitation of its own successes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from experiments.demonstrations.segmentation import decisions
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.experience.observations import BoolArray, IntArray, take
from sb3_options.experience.trajectories import Trajectory

UPDATES = 1000
"""Gradient steps of behaviour cloning before the first step of training."""

BATCH_SIZE = 256

LEARNING_RATE = 1e-3

HELD = 15_000
"""Primitive steps for which only the value function learns. A new one would undo what was cloned."""

STEPS_PER_UPDATE = 40
"""Primitive steps of training for a gradient step of imitation, about as many as PPO makes itself."""

RECENT = 100
"""Episodes, of which fewer than half succeed where there is imitation. Above that it would slow PPO down."""

STEPS_PER_SEGMENTATION = 5_000
"""Primitive steps after which demonstrations are segmented anew, by the options of then."""


class Decisions(NamedTuple):
    """What was chosen in an episode.

    Attributes:
        observations: (n, d).
        actions: Augmented, (n,).
        masks: Which were available, (n, n_primitive + max_options).
    """

    observations: Any
    actions: IntArray
    masks: BoolArray


class Cloning(BaseCallback):
    """Begins MaskablePPO with the decisions of demonstrations (Pomerleau 1991).

    The value function is not cloned: fitted to successes only, it takes every failure for a surprise, and the first
    updates undo what was cloned. It learns for the first `HELD` steps, while the policy stays as it is. Put this
    callback after the one that discovers.

    Args:
        discovery: Whose options are decisions, too.
        demonstrations: Successful ones.
        seed: Of the batches.
        imitates: Whether the policy is also fitted to the agent's own last successes (self-imitation, Oh et al. 2018),
            and to demonstrations in the place of those that are still missing, while fewer than half of the last
            `RECENT` episodes succeed.
    """

    def __init__(
        self, discovery: SubgoalDiscoveryCallback, demonstrations: Sequence[Trajectory], seed: int, *, imitates: bool
    ) -> None:
        super().__init__()
        self.discovery = discovery
        self.demonstrations = demonstrations
        self.generator = torch.Generator().manual_seed(seed)
        self.imitates = imitates
        self.own: deque[Decisions] = deque(maxlen=len(demonstrations))
        self._under_way: list[list[list[Any]]] = []
        self._shown: list[Decisions] = []
        self._segmented_at = 0
        self._imitated_at = 0

    def _on_training_start(self) -> None:
        policy: Any = self.model.policy
        self._under_way = [[] for _ in range(self.training_env.num_envs)]
        self._shown = self._segmented()
        self.fit(torch.optim.Adam(policy.parameters(), LEARNING_RATE), UPDATES)

    def _on_rollout_start(self) -> None:
        policy: Any = self.model.policy
        steps = self.model.num_timesteps
        held = steps < HELD
        value = {*policy.value_net.parameters(), *policy.mlp_extractor.value_net.parameters()}
        for parameter in policy.parameters():
            parameter.requires_grad_(parameter in value or not held)
        n_successes = sum(each.success for each in self.discovery.history[-RECENT:])
        if held or not self.imitates or n_successes >= RECENT / 2:
            self._imitated_at = steps
        else:
            if steps - self._segmented_at >= STEPS_PER_SEGMENTATION:
                self._segmented_at = steps
                self._shown = self._segmented()
            updates = (steps - self._imitated_at) // STEPS_PER_UPDATE
            self._imitated_at += updates * STEPS_PER_UPDATE
            self.fit(policy.optimizer, updates)

    def _on_step(self) -> bool:
        model: Any = self.model
        for env, info in enumerate(self.locals["infos"]):
            now = model._last_obs, self.locals["actions"], self.locals["action_masks"]
            self._under_way[env].append([np.copy(part[env]) for part in now])
            if "episode" in info:
                if info["episode"]["r"] > 0:
                    self.own.append(Decisions(*(np.array(part) for part in zip(*self._under_way[env], strict=True))))
                self._under_way[env] = []
        return True

    def _segmented(self) -> list[Decisions]:
        bank = self.discovery.bank
        return [Decisions(take(each.states, each.visits[:-1]), *decisions(each, bank)) for each in self.demonstrations]

    def fit(self, optimizer: torch.optim.Optimizer, updates: int) -> None:
        """Fit the policy to decisions, by maximum likelihood."""
        policy: Any = self.model.policy
        episodes = [*self.own, *islice(self._shown, len(self.own), None)]
        observations, actions, masks = (np.concatenate(part) for part in zip(*episodes, strict=True))
        policy.set_training_mode(True)
        for _ in range(updates):
            rows = torch.randint(len(actions), (BATCH_SIZE,), generator=self.generator).numpy()
            batch, _ = policy.obs_to_tensor(observations[rows])
            chosen = torch.as_tensor(actions[rows], device=policy.device)
            _, log_prob, _ = policy.evaluate_actions(batch, chosen, masks[rows])
            optimizer.zero_grad()
            (-log_prob.mean()).backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
            optimizer.step()
