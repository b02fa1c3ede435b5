"""Behaviour cloning: a policy begins with the decisions of demonstrations, over primitives and options."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize, is_vecenv_wrapped

from sb3_options.experience.observations import FloatArray, IntArray, Observations, concatenate, take
from sb3_options.experience.trajectories import Trajectory
from sb3_options.learning.families import Masked, Recurrent, Sampled, family_of
from sb3_options.options.bank import OptionBank
from sb3_options.options.segmentation import decisions

EPISODES = 20
"""Episodes of the cloned policy from which the value function is estimated."""

UPDATES = 1000
BATCH_SIZE = 256
LEARNING_RATE = 1e-3


class Cloning:
    """A warm start of PPO, A2C, TRPO or MaskablePPO from demonstrations.

    The policy is fitted to their decisions by maximum likelihood (Pomerleau 1991). The value function is not: fitted to
    successes only, it takes every failure for a surprise; random, it makes noise of the first advantages. Either way
    the first updates undo what was cloned. So the policy stays as it is for `EPISODES` episodes, and the value function
    is fitted to their returns.
    """

    STATE: ClassVar[tuple[str, ...]] = ("waits", "_episodes", "_cloned")

    def __init__(self) -> None:
        self.waits = False
        self._episodes: list[Trajectory] = []
        self._cloned: dict[str, npt.NDArray[Any]] = {}  # the policy while an update is made

    def begin(self, model: Any, bank: OptionBank, demonstrations: Sequence[Trajectory]) -> float:
        """Fit the policy.

        Args:
            model: One that `can_clone`, with the heads of the options open.
            bank: The options, which are decisions, too.
            demonstrations: Successful ones.

        Returns:
            The mean probability of the last batch's decisions (geometric).

        Raises:
            ValueError: The policy sees stacked frames, which demonstrations do not hold.
        """
        if is_vecenv_wrapped(model.get_env(), VecFrameStack):
            raise ValueError(
                "Demonstrations hold single frames, and the policy sees stacked ones: stack frames beneath "
                "OptionsWrapper, or pass SubgoalDiscoveryCallback(clone=False)."
            )
        if (normalizer := model.get_vec_normalize_env()) is not None:
            _begin_statistics(normalizer, concatenate([each.states for each in demonstrations]))
        actions, masks = map(np.concatenate, zip(*(decisions(each, bank) for each in demonstrations), strict=True))
        masked = isinstance(family_of(model), Masked)

        def surprise(batch: Any, rows: IntArray) -> torch.Tensor:
            chosen = torch.as_tensor(actions[rows], device=model.device)
            log_prob: torch.Tensor
            _, log_prob, _ = model.policy.evaluate_actions(batch, chosen, *([masks[rows]] if masked else []))
            return -log_prob.mean()

        self.waits = True
        return float(np.exp(-_fit(model, demonstrations, list(model.policy.parameters()), surprise)))

    def add(self, trajectory: Trajectory) -> None:
        """Take an episode of the cloned policy, as long as it is waited for."""
        if self.waits:
            self._episodes.append(trajectory)

    def on_rollout_end(self, model: Any) -> None:
        """Remember the policy before an update."""
        if self.waits:
            self._cloned = {name: value.cpu().numpy().copy() for name, value in model.policy.state_dict().items()}

    def on_rollout_start(self, model: Any) -> None:
        """Put the policy back after an update, or, after enough episodes, begin to learn."""
        if self._cloned:
            model.policy.load_state_dict({name: torch.as_tensor(value) for name, value in self._cloned.items()})
            model.policy.optimizer.state.clear()
            self._cloned = {}
        if self.waits and len(self._episodes) >= EPISODES:
            _fit_value(model, self._episodes)
            self.waits = False
            self._episodes.clear()


def can_clone(model: BaseAlgorithm) -> bool:
    """Whether the model has a policy without memory that can be fitted: PPO, A2C, TRPO, MaskablePPO."""
    family = family_of(model)
    return isinstance(family, Sampled) and not isinstance(family, Recurrent)


def _fit_value(model: Any, episodes: Sequence[Trajectory]) -> None:
    """Fit the value function alone to the returns of episodes."""
    policy = model.policy
    returns = np.concatenate([_returns(each.rewards, model.gamma) for each in episodes])
    if (normalizer := model.get_vec_normalize_env()) is not None:
        returns = normalizer.normalize_reward(returns)
    own = [value for name, value in policy.named_parameters() if "value_net" in name or name.startswith("vf_features")]

    def error(batch: Any, rows: IntArray) -> torch.Tensor:
        targets = torch.as_tensor(returns[rows], dtype=torch.float32, device=model.device)
        return torch.nn.functional.mse_loss(policy.predict_values(batch).flatten(), targets)

    _fit(model, episodes, own, error)


def _returns(rewards: FloatArray, gamma: float) -> FloatArray:
    """Discounted sums of the rewards from each step on, (T,)."""
    returns = np.zeros(len(rewards) + 1)
    for step in reversed(range(len(rewards))):
        returns[step] = rewards[step] + gamma * returns[step + 1]
    return returns[:-1]


def _fit(
    model: Any,
    trajectories: Sequence[Trajectory],
    parameters: list[torch.nn.Parameter],
    loss_of: Callable[[Any, IntArray], torch.Tensor],
) -> float:
    """Minimise a loss over all steps of trajectories; the loss of the last batch.

    ``loss_of`` takes a batch of observations as the policy's networks do, and their numbers among all steps.
    """
    states = concatenate([each.states for each in trajectories])
    firsts = np.cumsum([0, *(each.visits.max() + 1 for each in trajectories)])
    seen = np.concatenate([first + each.visits[:-1] for first, each in zip(firsts, trajectories, strict=False)])
    normalizer = model.get_vec_normalize_env()
    generator = torch.Generator().manual_seed(model.seed or 0)
    optimizer = torch.optim.Adam(parameters, LEARNING_RATE)
    model.policy.set_training_mode(True)
    for _ in range(UPDATES):
        rows = torch.randint(len(seen), (BATCH_SIZE,), generator=generator).numpy()
        observations = take(states, seen[rows])
        batch, _ = model.policy.obs_to_tensor(
            observations if normalizer is None else normalizer.normalize_obs(observations)
        )
        loss = loss_of(batch, rows)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch's
        torch.nn.utils.clip_grad_norm_(parameters, 0.5)
        optimizer.step()
    return loss.item()


def _begin_statistics(normalizer: VecNormalize, observations: Observations) -> None:
    """Let the statistics of observations begin with those of the demonstrations."""
    if normalizer.norm_obs and normalizer.training:
        if isinstance(normalizer.obs_rms, dict):
            for key, statistics in normalizer.obs_rms.items():
                statistics.update(observations[key])
        else:
            normalizer.obs_rms.update(observations)
