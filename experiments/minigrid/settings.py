"""Families of tasks, agents, and the settings that all agents share."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

Arm = Literal["stock", "stock, curriculum", "discovered", "hand-made"]
ARMS: tuple[Arm, ...] = ("discovered", "hand-made", "stock, curriculum", "stock")
"""``stock``: PPO in the last task alone, for the frames of all stages. ``stock, curriculum``: PPO through all stages,
weights carried over. ``discovered``: the same with options that are discovered in the first stage and kept.
``hand-made``: the same with options by hand from the first step on, the bound."""


class Stage(NamedTuple):
    """A task and its budget.

    Attributes:
        env_id: Of the task.
        frames: Primitive steps.
    """

    env_id: str
    frames: int


FAMILIES: dict[str, tuple[Stage, ...]] = {
    "MultiRoom-4": (
        Stage("MiniGrid-MultiRoom-N2-S4-v0", 40_000),
        Stage("MiniGrid-MultiRoom-N4-S5-v1", 80_000),
    ),
    "MultiRoom-6": (
        Stage("MiniGrid-MultiRoom-N2-S4-v0", 40_000),
        Stage("MiniGrid-MultiRoom-N4-S5-v0", 160_000),
    ),
    "DoorKey": (
        Stage("MiniGrid-DoorKey-5x5-v0", 60_000),
        Stage("MiniGrid-DoorKey-8x8-v0", 90_000),
    ),
}
"""Stages of each family, the last one is the task. ``MultiRoom-N4-S5-v0`` has six rooms, ``-v1`` has four."""

GAMMA = 0.99
N_ENVS = 16
PPO: dict[str, Any] = {
    "n_steps": 128, "batch_size": 256, "n_epochs": 4, "learning_rate": 1e-3, "gae_lambda": 0.95, "clip_range": 0.2,
    "ent_coef": 0.01, "vf_coef": 0.5, "max_grad_norm": 0.5, "gamma": GAMMA,
}  # fmt: skip
"""As rl-starter-files publishes them for MiniGrid, with 16 environments; the network is SB3's ``MlpPolicy``."""

MAX_OPTIONS = 4
DISCOVERY: dict[str, Any] = {"capacity": 500, "start_radius": 0.5, "goal_radius": 0.5}
"""Successes are rare at first, so many trajectories are kept. On few features near the start is nearly everywhere."""

OPENING_SHARE = 0.5
EPISODES = 100
"""Of an evaluation, and of the training success that is reported."""

REACHED = (0.5, 0.8, 0.9)
"""Success rates whose frames are reported."""
