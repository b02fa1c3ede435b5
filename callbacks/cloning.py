"""Behaviour cloning: a policy begins with the decisions of demonstrations, over primitives and options."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, is_vecenv_wrapped

from sb3_options.experience.observations import Observations, concatenate, take
from sb3_options.experience.trajectories import Trajectory
from sb3_options.learning.families import Masked, Recurrent, Sampled, family_of
from sb3_options.options.bank import OptionBank
from sb3_options.options.segmentation import decisions

UPDATES = 1000
"""Gradient steps before the first step of training."""

BATCH_SIZE, LEARNING_RATE = 256, 1e-3

MAX_GRAD_NORM = 0.5
"""Longest gradient, as in SB3's PPO."""


def can_clone(model: BaseAlgorithm) -> bool:
    """Whether the model has a policy without memory that can be fitted: PPO, A2C, TRPO, MaskablePPO."""
    family = family_of(model)
    return isinstance(family, Sampled) and not isinstance(family, Recurrent)


def check_clonable(venv: VecEnv) -> None:
    """Refuse environments whose policy sees what demonstrations do not hold."""
    if is_vecenv_wrapped(venv, VecFrameStack):
        raise ValueError(
            "Demonstrations hold single frames, and the policy sees stacked ones: stack frames beneath OptionsWrapper, "
            "or pass SubgoalDiscoveryCallback(clone=False)."
        )


class Imitation:
    """The decisions of demonstrations, as a loss of a policy: their negative log likelihood (Pomerleau 1991).

    Args:
        model: One that `can_clone`, with the heads of the options open.
        bank: The options, which are decisions, too.
        demonstrations: Successful ones.
    """

    def __init__(self, model: Any, bank: OptionBank, demonstrations: Sequence[Trajectory]) -> None:
        self.model = model
        self.states = concatenate([each.states for each in demonstrations])
        self._normalizer: VecNormalize | None = model.get_vec_normalize_env()
        self._masked = isinstance(family_of(model), Masked)
        chosen = (decisions(each, bank) for each in demonstrations)
        self._actions, self._masks = map(np.concatenate, zip(*chosen, strict=True))
        firsts = np.cumsum([0, *(each.visits.max() + 1 for each in demonstrations[:-1])])
        visits = [first + each.visits[:-1] for first, each in zip(firsts, demonstrations, strict=True)]
        self._seen = np.concatenate(visits)
        self._generator = torch.Generator().manual_seed(model.seed or 0)

    def loss(self) -> torch.Tensor:
        """Return the loss of a random batch."""
        rows = torch.randint(len(self._seen), (BATCH_SIZE,), generator=self._generator).numpy()
        observations = take(self.states, self._seen[rows])
        if self._normalizer is not None:
            observations = self._normalizer.normalize_obs(observations)
        batch, _ = self.model.policy.obs_to_tensor(observations)
        chosen = torch.as_tensor(self._actions[rows], device=self.model.device)
        masks = [self._masks[rows]] if self._masked else []
        _, log_prob, _ = self.model.policy.evaluate_actions(batch, chosen, *masks)
        return torch.as_tensor(-log_prob.mean())


def clone(model: Any, bank: OptionBank, demonstrations: Sequence[Trajectory]) -> float:
    """Fit a policy to the decisions of demonstrations by maximum likelihood.

    The value function is left alone: fitted to successes only, it takes every failure for a surprise, and the first
    updates of PPO undo what was cloned. Arguments are those of `Imitation`.

    Returns:
        The mean probability of the last batch's decisions (geometric).
    """
    imitation = Imitation(model, bank, demonstrations)
    if (normalizer := model.get_vec_normalize_env()) is not None:
        _begin_statistics(normalizer, imitation.states)
    policy = model.policy
    optimizer = torch.optim.Adam(policy.parameters(), LEARNING_RATE)
    policy.set_training_mode(True)
    for _ in range(UPDATES):
        loss = imitation.loss()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch ships no annotation for it
        torch.nn.utils.clip_grad_norm_(policy.parameters(), MAX_GRAD_NORM)
        optimizer.step()
    return math.exp(-loss.item())


def _begin_statistics(normalizer: VecNormalize, observations: Observations) -> None:
    """Let the statistics of observations begin with those of the demonstrations."""
    if normalizer.norm_obs and normalizer.training:
        if isinstance(normalizer.obs_rms, dict):
            for key, statistics in normalizer.obs_rms.items():
                statistics.update(observations[key])
        else:
            normalizer.obs_rms.update(observations)
