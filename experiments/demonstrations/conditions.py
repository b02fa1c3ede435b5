"""What is compared: MaskablePPO and DQN from the same demonstrations, with options and without."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from experiments.common.seeds import Result
from experiments.deep.settings import DeepSettings
from experiments.demonstrations.tasks import TASKS
from sb3_options import OptionDQN, OptionsWrapper, record_demonstrations
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.cloning import Imitation
from sb3_options.callbacks.demonstrated import FAILURES
from sb3_options.checkpoints.demonstrations import MANY
from sb3_options.experience.trajectories import Trajectory
from sb3_options.runs.config import CLONED, CLONED_FROM_MANY, FITTED

Arm = Literal[
    "options, cloning", "cloning", "options", "cloning, demonstration loss",
    "PPO", "DQN, options, cloning", "DQN, cloning", "DQN, options", "DQN",
]  # fmt: skip

ARMS: tuple[Arm, ...] = get_args(Arm)
"""Of MaskablePPO, unless DQN is named. ``demonstration loss``: every gradient of PPO includes that of
`DemonstrationLoss`. ``DQN, cloning`` is a form of DQfD (Hester et al. 2018): its buffer has no priorities. ``PPO`` and
``DQN`` have no demonstrations."""

LEARNED, EPISODES = 0.8, 100
"""A run ends when so large a share of so many episodes in a row succeeds."""

N_ENVS = 8

FIRST_SEED = 10_000
"""Of the episodes that are shown; those of training have others."""


class UntilLearned(BaseCallback):
    """Ends training when `LEARNED`. An episode succeeds ``within`` so many steps; with None, if it is rewarded."""

    def __init__(self, within: float | None) -> None:
        super().__init__()
        self.within = within
        self.recent: deque[bool] = deque(maxlen=EPISODES)

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                episode = info["episode"]
                self.recent.append(episode["r"] > 0 if self.within is None else episode["l"] <= self.within)
        return not self.learned

    @property
    def learned(self) -> bool:
        """Whether training may end."""
        return len(self.recent) == EPISODES and float(np.mean(self.recent)) >= LEARNED


DQN: dict[str, Any] = DeepSettings().arguments("dqn", "stock")
"""Chosen without options."""

LOSS_WEIGHT, LOSS_DECAY = 0.1, 0.99
"""Weight of the demonstration loss in the first update, and its factor after each. Rajeswaran et al. (2018) have 0.1
and 0.95; from twenty demonstrations of KeyCorridorS3R3, seeds 100 and 101 learned with 0.99 and not with 0.95."""


class DemonstrationLoss(BaseCallback):
    """Adds the gradient of the demonstrations' decisions to each of PPO's: DAPG (Rajeswaran et al. 2018, eq. 7).

    As in the authors' code, the largest advantage is left out of the weight. The loss is the mean of a random batch,
    and its gradient is added after PPO's was clipped.
    """

    def __init__(self, discovery: SubgoalDiscoveryCallback, demonstrations: Sequence[Trajectory]) -> None:
        super().__init__()
        self.discovery = discovery
        self.demonstrations = demonstrations
        self.weight = LOSS_WEIGHT

    def _on_training_start(self) -> None:
        imitation = Imitation(self.model, self.discovery.bank, self.demonstrations)

        def add(optimizer: torch.optim.Optimizer, *_: Any) -> None:
            parameters = [each for group in optimizer.param_groups for each in group["params"]]
            loss = self.weight * imitation.loss()
            for parameter, gradient in zip(
                parameters, torch.autograd.grad(loss, parameters, allow_unused=True), strict=True
            ):
                if gradient is not None:
                    parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient

        self.hook = self.model.policy.optimizer.register_step_pre_hook(add)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps:
            self.weight *= LOSS_DECAY

    def _on_training_end(self) -> None:
        self.hook.remove()


def after_cloning(episodes: int) -> dict[str, Any]:
    """What ``train.py`` sets for a policy that was cloned from so many demonstrations, if all of them succeed."""
    return CLONED_FROM_MANY if episodes >= MANY else CLONED


def run(task: str, arm: Arm, episodes: int, noise: float, seed: int, shown_in: str | None = None) -> Result:
    """Frames until learned, those of the demonstrations and of random failures included; None where it is not.

    ``shown_in``: another task, in which the expert acts and random actions fail.
    """
    of = TASKS[task]
    max_options = of.max_options if "options" in arm else 0
    of_dqn = arm.startswith("DQN")
    cloned: dict[str, Any] = {"max_runs": None}
    if "cloning" in arm:
        cloned |= FITTED if of_dqn else after_cloning(episodes)
    max_runs = cloned.pop("max_runs")

    def wrapped(name: str = task) -> OptionsWrapper:
        return OptionsWrapper(TASKS[name].make(), max_options, gamma=of.gamma, max_runs=max_runs)

    shown: list[Trajectory] = []
    failures: list[Trajectory] = []
    if arm not in ("PPO", "DQN"):
        env = wrapped(shown_in or task)
        shown = record_demonstrations(env, of.expert(env, noise, seed), episodes, seed=FIRST_SEED + 1000 * seed)
        walks = min(episodes, FAILURES) if max_options else 0
        failures = env.random_trajectories(walks, max(map(len, shown)), FIRST_SEED + 1000 * seed)
    frames = sum(map(len, [*shown, *failures]))
    discovery = SubgoalDiscoveryCallback(
        **of.discovery,
        demonstrations=[*shown, *failures] or None,
        clone="cloning" in arm,
        max_new_options=None if max_options else 0,
    )
    end = UntilLearned(of.within)
    venv = make_vec_env(wrapped, N_ENVS, seed=seed)
    model: Any
    if of_dqn:
        model = OptionDQN("MlpPolicy", venv, gamma=of.gamma, seed=seed, **DQN | cloned)
    else:
        model = MaskablePPO("MlpPolicy", venv, gamma=of.gamma, seed=seed, **dict(of.ppo) | cloned)
    loss = [DemonstrationLoss(discovery, shown)] if "loss" in arm else []
    model.learn(of.frames - frames, [discovery, *loss, end])
    return {
        "seed": seed,
        "learned": frames + model.num_timesteps if end.learned else None,
        "demonstrations": frames,
        "success": float(np.mean(end.recent)) if end.recent else 0.0,
        "options": [each.where for each in discovery.discoveries],
    }
