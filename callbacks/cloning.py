"""A policy begins with the decisions of demonstrations, over primitives and options.

Policies that sample are fitted to them by behaviour cloning (`clone`), action values by a large margin (`MarginLoss`).
"""

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, is_vecenv_wrapped
from torch.utils.hooks import RemovableHandle

from sb3_options.experience.observations import Observations, concatenate, take
from sb3_options.experience.option_run import OptionRun
from sb3_options.experience.trajectories import Trajectory
from sb3_options.learning.families import Masked, Recurrent, Sampled, ValueBased, family_of
from sb3_options.learning.heads import networks
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.options.bank import OptionBank
from sb3_options.options.segmentation import explained

UPDATES = 1000  # gradient steps before the first step of training
TARGET_UPDATES = 100  # of these between two copies to the target network
BATCH_SIZE, LEARNING_RATE = 256, 1e-3
MAX_GRAD_NORM = 0.5  # longest gradient, as in SB3's PPO

MARGIN = 0.8
"""By how much the value of a demonstrated decision should exceed all others (Hester et al. 2018)."""

FALLS_OVER = 0.5
"""Share of training over which the weight of the margin falls to 0: measured in docs/studies/demonstrations.md."""


def can_clone(model: BaseAlgorithm) -> bool:
    """Whether the model has a network without memory that can be fitted: all algorithms but RecurrentPPO and MacroQ."""
    family = family_of(model)
    return isinstance(family, Sampled | ValueBased) and not isinstance(family, Recurrent)


def check_clonable(venv: VecEnv) -> None:
    """Refuse environments whose policy sees what demonstrations do not hold."""
    if is_vecenv_wrapped(venv, VecFrameStack):
        raise ValueError(
            "Demonstrations hold single frames, and the policy sees stacked ones: stack frames beneath OptionsWrapper, "
            "or pass SubgoalDiscoveryCallback(clone=False)."
        )


class Imitation:
    """The decisions of demonstrations, as a loss of a policy: their negative log likelihood (Pomerleau 1991).

    Of several options that explain a step, the decision is the one that takes the demonstration farthest. The model
    `can_clone`, and the heads of its options are open. The demonstrations are successful.
    """

    STATE = ("_generator",)

    def __init__(self, model: Any, bank: OptionBank, demonstrations: Sequence[Trajectory]) -> None:
        self.model = model
        self.bank = bank
        self.demonstrations = demonstrations
        self.states = concatenate([each.states for each in demonstrations])
        firsts = np.cumsum([0, *(each.visits.max() + 1 for each in demonstrations[:-1])])
        visits = [first + each.visits[:-1] for first, each in zip(firsts, demonstrations, strict=True)]
        self._seen = np.concatenate(visits)
        self._generator = torch.Generator().manual_seed(model.seed or 0)
        self._label()

    def _label(self) -> None:
        """Find the decisions by the present options."""
        self._slots = self.bank.slots
        found = [explained(each, self.bank) for each in self.demonstrations]
        self._durations = np.concatenate([durations for durations, _ in found])
        self._masks = np.concatenate([masks[:-1] for _, masks in found])
        self._actions = self._durations.argmax(axis=1)

    def _batch(self, size: int) -> tuple[Any, torch.Tensor, Any]:
        """Return random observations as the policy sees them, their decisions, and their rows."""
        rows = torch.randint(len(self._seen), (size,), generator=self._generator).numpy()
        observations = take(self.states, self._seen[rows])
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None:
            observations = normalizer.normalize_obs(observations)
        batch, _ = self.model.policy.obs_to_tensor(observations)
        return batch, torch.as_tensor(self._actions[rows], device=self.model.device), rows

    def loss(self) -> torch.Tensor:
        """Return the loss of a random batch."""
        batch, chosen, rows = self._batch(BATCH_SIZE)
        masks = [self._masks[rows]] if isinstance(family_of(self.model), Masked) else []
        _, log_prob, _ = self.model.policy.evaluate_actions(batch, chosen, *masks)
        return torch.as_tensor(-log_prob.mean())


class MarginLoss(Imitation):
    """The decisions of demonstrations, as a loss of action values (Hester et al. 2018, eq. 2).

    The value of a decision has to exceed those of all actions by `MARGIN`, but for others that explain the step: these
    must not exceed it. The weight falls to 0 over the first half of the training (`FALLS_OVER`), so that the agent
    may become better than the demonstrations. Decisions follow the options of the bank when these change.
    """

    _hook: RemovableHandle | None = None

    def loss(self) -> torch.Tensor:
        """Return the loss of a random batch."""
        if any(then is not now for then, now in zip(self._slots, self.bank.slots, strict=True)):
            self._label()
        batch, chosen, rows = self._batch(self.model.batch_size)
        values = ValueBased(self.model).outputs(batch)
        values = values.mean(dim=1) if values.dim() == 3 else values  # of quantiles
        explains = torch.as_tensor(self._durations[rows] > 0, device=values.device)
        rivals = torch.where(explains, values, values + MARGIN)
        if self.model.replay_buffer.tracks_availability:  # the model never chooses an unavailable option
            rivals = rivals.masked_fill(~torch.as_tensor(self._masks[rows], device=values.device), -torch.inf)
        return (rivals.max(dim=1).values - values.gather(1, chosen[:, None])[:, 0]).mean()

    def begin(self) -> None:
        """Add the gradient of the loss to every update of the model until `end`, after SB3 has clipped its own."""
        self.end()
        self._hook = self.model.policy.optimizer.register_step_pre_hook(self._add)

    def end(self) -> None:
        """Leave updates as they are."""
        if self._hook is not None:
            self._hook.remove()
            self._hook = None

    def _add(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        weight = 1.0 - (1.0 - self.model._current_progress_remaining) / FALLS_OVER
        if weight <= 0.0:
            return
        parameters = [each for group in optimizer.param_groups for each in group["params"] if each.requires_grad]
        gradients = torch.autograd.grad(weight * self.loss(), parameters, allow_unused=True)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            if gradient is not None:
                parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient


def clone(model: Any, bank: OptionBank, demonstrations: Sequence[Trajectory]) -> float:
    """Fit a policy that samples to the decisions of demonstrations by maximum likelihood.

    The value function is left alone: fitted to successes only, it takes every failure for a surprise, and the first
    updates of PPO undo what was cloned. Return the mean probability of the last batch's decisions (geometric).
    """
    imitation = Imitation(model, bank, demonstrations)
    _begin_statistics(model, imitation.states)
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


def fit_values(imitation: MarginLoss, buffer: OptionReplayBuffer) -> None:
    """Put demonstrations into the replay buffer, and fit action values to them with the margin, by the model's updates.

    They are rows like all others, and are overwritten once the buffer is full.
    """
    model = imitation.model
    _begin_statistics(model, imitation.states, imitation.demonstrations)
    for trajectory in imitation.demonstrations:
        _store(trajectory, imitation.bank, buffer, model.gamma)
    model._update_current_progress_remaining(model.num_timesteps, model._total_timesteps)  # for the learning rate
    imitation.begin()
    try:
        for update in range(UPDATES):
            if update % TARGET_UPDATES == 0:
                online, target = networks(model.policy)
                target.load_state_dict(online.state_dict())
            model.train(1, model.batch_size)
    finally:
        imitation.end()


def _store(trajectory: Trajectory, bank: OptionBank, buffer: OptionReplayBuffer, gamma: float) -> None:
    """Store a demonstration as the decisions of an agent that takes an option wherever one explains the next steps."""
    durations, masks = explained(trajectory, bank)
    observed = buffer.as_stored(take(trajectory.states, trajectory.visits))
    at = 0
    while at < len(trajectory):
        action = int(durations[at].argmax())
        to = at + int(durations[at, action])
        run = OptionRun(-1, 1, gamma, gamma, "primitive", available=masks[to : to + 1, bank.n_primitive :])
        if action >= bank.n_primitive:
            run = run._replace(
                index=action - bank.n_primitive,
                duration=to - at,
                discount=gamma ** (to - at),
                termination="subgoal",
                observations=take(trajectory.states, trajectory.visits[at:to]),
                actions=trajectory.actions[at:to],
                rewards=trajectory.rewards[at:to],
                available=masks[at + 1 : to + 1, bank.n_primitive :],
                inside=True,
            )
        rewards = trajectory.rewards[at:to] @ gamma ** np.arange(to - at)
        ends = to == len(trajectory)
        info = {"option": run.as_info(), "TimeLimit.truncated": ends and not trajectory.terminated}
        here, there = take(observed, [at]), take(observed, [to])
        buffer.add(here, there, np.array([action]), np.array([rewards]), np.array([ends]), [info])
        at = to


def _begin_statistics(model: Any, observations: Observations, rewarded: Sequence[Trajectory] = ()) -> None:
    """Let the statistics of observations and returns begin with those of demonstrations."""
    normalizer: VecNormalize | None = model.get_vec_normalize_env()
    if normalizer is None or not normalizer.training:
        return
    if normalizer.norm_obs:
        if isinstance(normalizer.obs_rms, dict):
            for key, statistics in normalizer.obs_rms.items():
                statistics.update(observations[key])
        else:
            normalizer.obs_rms.update(observations)
    if normalizer.norm_reward:
        for each in rewarded:
            so_far = accumulate(each.rewards, lambda total, reward: total * normalizer.gamma + reward)
            normalizer.ret_rms.update(np.array(list(so_far)))
