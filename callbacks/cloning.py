"""Behaviour cloning: a policy begins with the decisions of demonstrations, over primitives and options."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, is_vecenv_wrapped

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
    is fitted to their returns. Each environment gives as many: of the first to end most would be short ones, which
    succeeded.

    Attributes:
        waits: How many episodes of each environment are still waited for.
    """

    STATE: ClassVar[tuple[str, ...]] = ("waits", "_episodes", "_cloned")

    def __init__(self) -> None:
        self.waits: list[int] = []
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
        """
        if (normalizer := model.get_vec_normalize_env()) is not None:
            _begin_statistics(normalizer, concatenate([each.states for each in demonstrations]))
        actions, masks = map(np.concatenate, zip(*(decisions(each, bank) for each in demonstrations), strict=True))
        masked = isinstance(family_of(model), Masked)

        def surprise(batch: Any, rows: IntArray) -> torch.Tensor:
            chosen = torch.as_tensor(actions[rows], device=model.device)
            log_prob: torch.Tensor
            _, log_prob, _ = model.policy.evaluate_actions(batch, chosen, *([masks[rows]] if masked else []))
            return -log_prob.mean()

        self.waits = [math.ceil(EPISODES / model.n_envs)] * model.n_envs
        model.policy.set_training_mode(True)
        return float(np.exp(-_fit(model, demonstrations, list(model.policy.parameters()), surprise)))

    def add(self, trajectory: Trajectory, env: int) -> None:
        """Take an episode of the cloned policy in one of the environments, as long as it is waited for."""
        if self.waits and self.waits[env]:
            self.waits[env] -= 1
            self._episodes.append(trajectory)

    def on_rollout_end(self, model: Any) -> None:
        """Remember the policy before an update."""
        if self.waits:
            self._cloned = {name: value.cpu().numpy().copy() for name, value in model.policy.state_dict().items()}

    def on_rollout_start(self, model: Any) -> bool:
        """Put the policy back after an update; after enough episodes begin to learn, and say so."""
        if self._cloned:
            model.policy.load_state_dict({name: torch.as_tensor(value) for name, value in self._cloned.items()})
            model.policy.optimizer.state.clear()
            self._cloned = {}
        if not self.waits or any(self.waits):
            return False
        _fit_value(model, self._episodes)
        self.waits = []
        self._episodes.clear()
        return True


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


def _fit_value(model: Any, episodes: Sequence[Trajectory]) -> None:
    """Fit the value function alone to the returns of episodes. What was cut off goes on with the value of its end."""
    policy = model.policy
    normalizer = model.get_vec_normalize_env()
    returns, to_end = (
        np.concatenate(part) for part in zip(*(_returns(each, model.gamma) for each in episodes), strict=True)
    )
    if normalizer is not None and normalizer.norm_reward:
        returns = returns / np.sqrt(normalizer.ret_rms.var + normalizer.epsilon)
    of_episode = np.repeat(range(len(episodes)), [len(each) for each in episodes])
    ends = _seen_by(model, concatenate([take(each.states, each.visits[-1:]) for each in episodes]))
    own = [value for name, value in policy.named_parameters() if "value_net" in name or name.startswith("vf_features")]

    def error(batch: Any, rows: IntArray) -> torch.Tensor:
        with torch.no_grad():
            after = policy.predict_values(ends).flatten()[of_episode[rows]]
        targets, discounts = (
            torch.as_tensor(part[rows], dtype=torch.float32, device=model.device) for part in (returns, to_end)
        )
        return torch.nn.functional.mse_loss(policy.predict_values(batch).flatten(), targets + discounts * after)

    _fit(model, episodes, own, error)


def _returns(trajectory: Trajectory, gamma: float) -> tuple[FloatArray, FloatArray]:
    """Discounted sums of the rewards from each step on, and the discounts of what comes after the last; (T,) each."""
    n_steps = len(trajectory)
    returns = np.zeros(n_steps + 1)
    for step in reversed(range(n_steps)):
        returns[step] = trajectory.rewards[step] + gamma * returns[step + 1]
    discounts = np.zeros(n_steps) if trajectory.terminated else gamma ** np.arange(n_steps, 0, -1.0)
    return returns[:-1], discounts


def _seen_by(model: Any, observations: Observations) -> Any:
    """Observations as the model's networks take them."""
    normalizer = model.get_vec_normalize_env()
    batch, _ = model.policy.obs_to_tensor(
        observations if normalizer is None else normalizer.normalize_obs(observations)
    )
    return batch


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
    generator = torch.Generator().manual_seed(model.seed or 0)
    optimizer = torch.optim.Adam(parameters, LEARNING_RATE)
    for _ in range(UPDATES):
        rows = torch.randint(len(seen), (BATCH_SIZE,), generator=generator).numpy()
        loss = loss_of(_seen_by(model, take(states, seen[rows])), rows)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch's
        torch.nn.utils.clip_grad_norm_(parameters, 0.5)
        optimizer.step()
    model.policy.set_training_mode(False)
    return loss.item()


def _begin_statistics(normalizer: VecNormalize, observations: Observations) -> None:
    """Let the statistics of observations begin with those of the demonstrations."""
    if normalizer.norm_obs and normalizer.training:
        if isinstance(normalizer.obs_rms, dict):
            for key, statistics in normalizer.obs_rms.items():
                statistics.update(observations[key])
        else:
            normalizer.obs_rms.update(observations)
