"""What is compared: MaskablePPO from the same demonstrations, with and without options and cloning."""

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
from experiments.demonstrations.experts import expert_of
from sb3_options import OptionsWrapper, record_demonstrations
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.cloning import Imitation
from sb3_options.callbacks.demonstrated import FAILURES
from sb3_options.checkpoints.demonstrations import MANY
from sb3_options.envs.minigrid import DISCOVERY, make
from sb3_options.experience.trajectories import Trajectory
from sb3_options.runs.config import CLONED, CLONED_FROM_MANY

Arm = Literal["options, cloning", "cloning", "options", "cloning, demonstration loss"]

ARMS: tuple[Arm, ...] = get_args(Arm)
"""``demonstration loss``: every gradient of PPO includes that of `DemonstrationLoss`."""

TASKS = {
    "BabyAI-KeyCorridorS3R3-v0": 200_000,
    "BabyAI-KeyCorridorS4R3-v0": 300_000,
    "BabyAI-KeyCorridorS6R3-v0": 1_000_000,
    "MiniGrid-ObstructedMaze-1Dl-v0": 400_000,
    "MiniGrid-ObstructedMaze-2Dlh-v0": 3_000_000,
    "MiniGrid-LockedRoom-v0": 300_000,
    "BabyAI-UnlockToUnlock-v0": 300_000,
}
"""Frames after which a run is given up, by task."""

MISSIONS = ("MiniGrid-LockedRoom-v0",)
"""Tasks whose mission names what the agent cannot see: it is part of the observation."""

LEARNED, EPISODES = 0.8, 100
"""A run ends when so large a share of so many episodes in a row succeeds."""

MAX_OPTIONS, GAMMA, N_ENVS = 8, 0.99, 8

PPO: dict[str, Any] = {
    "learning_rate": 0.001,
    "n_steps": 128,
    "batch_size": 256,
    "n_epochs": 4,
    "gae_lambda": 0.95,
    "ent_coef": 0.01,
}
"""Those of ``train.py`` for MiniGrid."""

FIRST_SEED = 10_000
"""Of the episodes that are shown; those of training have others."""


class UntilLearned(BaseCallback):
    """Ends training when `LEARNED`."""

    def __init__(self) -> None:
        super().__init__()
        self.recent: deque[bool] = deque(maxlen=EPISODES)

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.recent.append(info["episode"]["r"] > 0)
        return not self.learned

    @property
    def learned(self) -> bool:
        """Whether training may end."""
        return len(self.recent) == EPISODES and float(np.mean(self.recent)) >= LEARNED


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
    max_options = MAX_OPTIONS if "options" in arm else 0
    cloned = dict(after_cloning(episodes)) if "cloning" in arm else {"max_runs": None}
    max_runs = cloned.pop("max_runs")

    def wrapped(env_id: str = task) -> OptionsWrapper:
        observed = make(env_id, mission=task in MISSIONS, last_action=True)
        return OptionsWrapper(observed, max_options, gamma=GAMMA, max_runs=max_runs)

    env = wrapped(shown_in or task)
    shown = record_demonstrations(env, expert_of(env, noise, seed), episodes, seed=FIRST_SEED + 1000 * seed)
    walks = min(episodes, FAILURES) if max_options else 0
    failures = env.random_trajectories(walks, max(map(len, shown)), FIRST_SEED + 1000 * seed)
    frames = sum(map(len, [*shown, *failures]))
    discovery = SubgoalDiscoveryCallback(
        **DISCOVERY,
        demonstrations=[*shown, *failures],
        clone="cloning" in arm,
        max_new_options=None if max_options else 0,
    )
    end = UntilLearned()
    model = MaskablePPO(
        "MlpPolicy",
        make_vec_env(wrapped, N_ENVS, seed=seed),
        gamma=GAMMA,
        seed=seed,
        policy_kwargs={"net_arch": [64, 64]},
        **PPO | cloned,
    )
    loss = [DemonstrationLoss(discovery, shown)] if "loss" in arm else []
    model.learn(TASKS[task] - frames, [discovery, *loss, end])
    return {
        "seed": seed,
        "learned": frames + model.num_timesteps if end.learned else None,
        "demonstrations": frames,
        "success": float(np.mean(end.recent)) if end.recent else 0.0,
        "options": [each.where for each in discovery.discoveries],
    }
