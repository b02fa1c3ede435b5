"""Behaviour cloning: a policy begins with the decisions of demonstrations, over primitives and options."""

from __future__ import annotations

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


def clone(model: Any, bank: OptionBank, demonstrations: Sequence[Trajectory]) -> float:
    """Fit a policy to the decisions of demonstrations by maximum likelihood (Pomerleau 1991).

    The value function is left alone: fitted to successes only, it takes every failure for a surprise, and the first
    updates of PPO undo what was cloned.

    Args:
        model: One that `can_clone`, with the heads of the options open.
        bank: The options, which are decisions, too.
        demonstrations: Successful ones.

    Returns:
        The mean probability of the last batch's decisions (geometric).
    """
    states = concatenate([each.states for each in demonstrations])
    if (normalizer := model.get_vec_normalize_env()) is not None:
        _begin_statistics(normalizer, states)
    actions, masks = map(np.concatenate, zip(*(decisions(each, bank) for each in demonstrations), strict=True))
    firsts = np.cumsum([0, *(each.visits.max() + 1 for each in demonstrations[:-1])])
    seen = np.concatenate([first + each.visits[:-1] for first, each in zip(firsts, demonstrations, strict=True)])
    policy = model.policy
    masked = isinstance(family_of(model), Masked)
    generator = torch.Generator().manual_seed(model.seed or 0)
    optimizer = torch.optim.Adam(policy.parameters(), LEARNING_RATE)
    policy.set_training_mode(True)
    for _ in range(UPDATES):
        rows = torch.randint(len(seen), (BATCH_SIZE,), generator=generator).numpy()
        observations = take(states, seen[rows])
        batch, _ = policy.obs_to_tensor(observations if normalizer is None else normalizer.normalize_obs(observations))
        chosen = torch.as_tensor(actions[rows], device=model.device)
        _, log_prob, _ = policy.evaluate_actions(batch, chosen, *([masks[rows]] if masked else []))
        optimizer.zero_grad()
        (-log_prob.mean()).backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), MAX_GRAD_NORM)
        optimizer.step()
    return float(log_prob.detach().mean().exp())


def _begin_statistics(normalizer: VecNormalize, observations: Observations) -> None:
    """Let the statistics of observations begin with those of the demonstrations."""
    if normalizer.norm_obs and normalizer.training:
        if isinstance(normalizer.obs_rms, dict):
            for key, statistics in normalizer.obs_rms.items():
                statistics.update(observations[key])
        else:
            normalizer.obs_rms.update(observations)
