"""What is compared: the arms of the study."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

from sb3_options.learning.novelty import NoveltyKind

Arm: TypeAlias = Literal[
    "stock", "carried", "n-step", "count-bonus", "rnd", "options", "options-n-step", "options-bonus", "repeats"
]
ARMS: tuple[Arm, ...] = get_args(Arm)
OPTIONS: frozenset[Arm] = frozenset({"options", "options-n-step", "options-bonus"})
"""Those with discovered options."""
STOCK: frozenset[Arm] = frozenset(ARMS) - OPTIONS - {"repeats"}
"""Those without option slots; the network of ``carried`` has learned the old task."""
N_STEP: frozenset[Arm] = frozenset({"n-step", "options-n-step"})
"""Those with n-step returns, which only algorithms with a replay buffer have."""
BONUS: dict[Arm, NoveltyKind] = {"count-bonus": "counts", "rnd": "rnd", "options-bonus": "counts"}
"""Those with an intrinsic reward, and of what kind."""


def has_arm(algo: str, arm: Arm) -> bool:
    """Whether there is such an arm of an algorithm."""
    if arm in N_STEP:
        return not algo.startswith("ppo")
    return arm not in BONUS or algo.startswith("ppo")  # bonuses need rollouts
