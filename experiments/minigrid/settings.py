"""Families of tasks, agents, and the settings that all agents share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

from sb3_options.learning.novelty import NoveltyKind

Arm = Literal[
    "discovered", "discovered, RND", "discovered, RND at first", "discovered, RND before the last",
    "discovered with φ, RND at first", "discovered with φ, RND before the last",
    "proposed groups, RND at first", "proposed groups, RND before the last",
    "learned map, RND at first", "learned map, RND before the last",
    "random subgoals", "random subgoals, RND at first", "random subgoals, RND before the last",
    "contrasting subgoals", "contrasting subgoals, RND at first", "contrasting subgoals, RND before the last",
    "hand-made", "hand-made subgoals", "hand-made subgoals, 3 cells", "hand-made subgoals, 2 cells",
    "stock, curriculum", "stock, RND", "stock, RND at first", "stock, RND before the last",
    "stock, NovelD", "stock, NovelD at first", "stock, NovelD before the last",
    "stock, E3B", "stock, E3B at first", "stock, E3B before the last",
    "stock with φ", "stock with φ, RND at first", "stock with φ, RND before the last",
    "stock, rl-zoo3's settings", "stock",
]  # fmt: skip
ARMS: tuple[Arm, ...] = get_args(Arm)
"""``stock``: PPO in the last task alone, for the frames of all stages. All others go through all stages and take the
weights along. ``stock, curriculum``: PPO; ``stock, rl-zoo3's settings``: with these; ``stock, RND``: with a bonus
for what is new in each task. ``with φ``: the agent sees φ beside the observation. ``discovered``: with options that
are discovered in the stages before the last, and kept; ``discovered, RND``: with the bonus. ``RND at first``: with
the bonus in the first task alone; ``RND before the last``: in all but the last. ``NovelD`` and ``E3B``: with these
bonuses instead. ``proposed groups``: as
``discovered``, but groups of features are proposed from random walks in the first task. ``learned map``: φ is learned
from the observation, without groups. ``random subgoals``: as
``discovered``, but subgoals are drawn, not found; ``contrasting subgoals``: drawn from what successes visit oftener
than failures. ``hand-made``: options by hand from the first step on, the bound. ``hand-made subgoals``: by hand, to
the subgoals that discovery finds in rooms, from wherever they are in view, or from so many cells away."""

RANDOM: tuple[Arm, ...] = tuple(arm for arm in ARMS if arm.startswith("random"))
CONTRASTING: tuple[Arm, ...] = tuple(arm for arm in ARMS if arm.startswith("contrasting"))
PROPOSED: tuple[Arm, ...] = tuple(arm for arm in ARMS if arm.startswith("proposed"))
WITH_MAP: tuple[Arm, ...] = tuple(arm for arm in ARMS if arm.startswith("learned map"))
DISCOVERED: tuple[Arm, ...] = (*(arm for arm in ARMS if arm.startswith("discovered")), *PROPOSED, *WITH_MAP)
DISCOVERING: tuple[Arm, ...] = (*DISCOVERED, *RANDOM, *CONTRASTING)
HAND_MADE: dict[Arm, int | None] = {
    "hand-made subgoals": None, "hand-made subgoals, 3 cells": 3, "hand-made subgoals, 2 cells": 2,
}  # fmt: skip
"""From how many cells away options by hand to the subgoals begin; None from wherever these are in view."""

WITH_FEATURES: tuple[Arm, ...] = tuple(arm for arm in ARMS if "with φ" in arm)
WITH_OPTIONS: tuple[Arm, ...] = (*DISCOVERING, "hand-made", *HAND_MADE)
BONUS_AT_FIRST: tuple[Arm, ...] = tuple(arm for arm in ARMS if arm.endswith("at first"))
BONUS_BEFORE_LAST: tuple[Arm, ...] = tuple(arm for arm in ARMS if arm.endswith("before the last"))
BONUS: dict[Arm, NoveltyKind] = {
    arm: kind for arm in ARMS for kind in get_args(NoveltyKind) if f", {kind}" in arm.lower()
}
"""Kind of bonus of the arms that have one."""

ZOO_ARM: Arm = "stock, rl-zoo3's settings"


class Stage(NamedTuple):
    """A task and its budget.

    Attributes:
        env_id: Of the task.
        frames: Primitive steps, those of all environments.
        rehearsed: Environments, of `N_ENVS`, that stay in the task before, so that the policy does not unlearn it while
            successes in the new one are rare.
        counts_decisions: Whether rollouts of agents with options count decisions, so that they take about three times
            the primitive steps.
    """

    env_id: str
    frames: int
    rehearsed: int = 0
    counts_decisions: bool = False


REHEARSED = 4
"""Of 16 environments. With none the policy unlearns everything in one of two runs of N6; with 8 it takes longer."""

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
    "DoorKey-16": (
        Stage("MiniGrid-DoorKey-5x5-v0", 60_000),
        Stage("MiniGrid-DoorKey-8x8-v0", 90_000),
        Stage("MiniGrid-DoorKey-16x16-v0", 150_000),
    ),
    "DoorKey-5-16": (
        Stage("MiniGrid-DoorKey-5x5-v0", 60_000),
        Stage("MiniGrid-DoorKey-16x16-v0", 150_000),
    ),
    "MultiRoom-N6": (
        Stage("MiniGrid-MultiRoom-N2-S4-v0", 60_000),
        Stage("MiniGrid-MultiRoom-N4-S5-v1", 160_000, REHEARSED),
        Stage("MiniGrid-MultiRoom-N4-S5-v0", 160_000, REHEARSED),
        Stage("MiniGrid-MultiRoom-N6-v0", 1_600_000, REHEARSED, counts_decisions=True),
    ),
    "MultiRoom-N2-N6": (
        Stage("MiniGrid-MultiRoom-N2-S4-v0", 40_000),
        Stage("MiniGrid-MultiRoom-N6-v0", 160_000),
    ),
    "FourRooms": (
        Stage("MiniGrid-MultiRoom-N2-S4-v0", 40_000),
        Stage("MiniGrid-FourRooms-v0", 160_000),
    ),
    "LockedRoom": (
        Stage("MiniGrid-DoorKey-5x5-v0", 60_000),
        Stage("MiniGrid-LockedRoom-v0", 200_000),
    ),
    "KeyCorridor": (
        Stage("MiniGrid-KeyCorridorS3R1-v0", 150_000),
        Stage("MiniGrid-KeyCorridorS3R2-v0", 300_000),
        Stage("MiniGrid-KeyCorridorS3R3-v0", 600_000),
    ),
}
"""Stages of each family, the last one is the task. ``MultiRoom-N4-S5-v0`` has six rooms, ``-v1`` has four."""

WITHOUT_MISSION = ("MiniGrid-LockedRoom-v0",)
"""Tasks whose missions the tasks before do not have; agents do without them."""

GAMMA = 0.99
N_ENVS = 16
PPO: dict[str, Any] = {
    "n_steps": 128, "batch_size": 256, "n_epochs": 4, "learning_rate": 1e-3, "gae_lambda": 0.95, "clip_range": 0.2,
    "ent_coef": 0.01, "vf_coef": 0.5, "max_grad_norm": 0.5, "gamma": GAMMA,
}  # fmt: skip
"""As rl-starter-files publishes them for MiniGrid, with 16 environments; the network is SB3's ``MlpPolicy``."""

ZOO: dict[str, Any] = {
    "n_steps": 128, "batch_size": 64, "n_epochs": 10, "learning_rate": 2.5e-4, "gae_lambda": 0.95, "clip_range": 0.2,
    "ent_coef": 0.0, "gamma": GAMMA,
}  # fmt: skip
"""As rl-zoo3 publishes them for MiniGrid, with 8 environments, and observations and rewards that are normalised."""

ZOO_N_ENVS = 8

ZOO_OF_TASK: dict[str, dict[str, Any]] = {"MiniGrid-FourRooms-v0": {"n_steps": 512}}
"""Where rl-zoo3 has others for a task of ours."""

WEIGHTS: dict[NoveltyKind, float] = {"rnd": 0.1, "noveld": 0.1, "e3b": 0.1}
"""Of the bonuses; 0.1 is the default of `IntrinsicRewardCallback`."""

Tuned: TypeAlias = Mapping[str, Any]
"""PPO's settings, and the ``weight`` of the bonus, of one agent; those that are missing are the study's."""

WALKS, LONGEST_WALK = 40, 400
"""Random walks in the first task from which groups are proposed, and primitive steps of each at most."""


def max_options(family: str) -> int:
    """Slots for options: as many as the family has use for by hand."""
    return {"DoorKey": 6, "LockedRoom": 6, "KeyCorridor": 8}.get(family.split("-")[0], 5)


DISCOVERY: dict[str, Any] = {
    "capacity": 500, "start_radius": 0.5, "goal_radius": 0.5, "salient_share": 0.6,
    "min_positive": 8, "decay": 0.8,
}  # fmt: skip
"""Successes are rare at first, so many trajectories are kept, and what is rarely come upon stands for them. On few
features near the start is nearly everywhere. What stands out by its contrast is no accident, so peaks need not persist
for long. Results up to seed 27019 had no `max_share`."""

WITHOUT_GROUPS: dict[str, Any] = {"capacity": 500}
"""Those of a learned map, where all features count together. The others are the library's defaults."""

GROWING_STAGES = 2
"""After so many tasks options stay as they are. In a third one a later version is another more than a better one, and
what the agent learned of the former is wrong."""

OPENING_SHARE = 0.5
EPISODES = 100
"""Of an evaluation, and of the training success that is reported."""

REACHED = (0.5, 0.8, 0.9)
"""Success rates whose frames are reported."""


def options_of(stage: int) -> dict[str, Any]:
    """How options are learned in a stage, counted from 0."""
    return {"grow": stage < GROWING_STAGES}


def primitive_rollouts(stage: Stage) -> bool:
    """Whether rollouts of agents with options count primitive steps in a stage."""
    return not stage.counts_decisions


def zoo_settings(family: str) -> dict[str, Any]:
    """Those of rl-zoo3 for the last task of a family."""
    return {**ZOO, **ZOO_OF_TASK.get(FAMILIES[family][-1].env_id, {})}


def tuned_of(arm: Arm, tuned: Tuned | None = None) -> dict[str, Any]:
    """PPO's settings, and the ``weight`` of the bonus if there is one, with those that were tuned."""
    return PPO | ({"weight": WEIGHTS[BONUS[arm]]} if arm in BONUS else {}) | dict(tuned or {})


def of(arm: Arm, family: str) -> dict[str, Any]:
    """What one arm alone has in a family."""
    special: dict[str, Any] = {}
    if arm in WITH_OPTIONS:
        special |= {"primitive_rollouts": True}
    if arm in DISCOVERING:
        special |= {"discovery": DISCOVERY, "opening_share": OPENING_SHARE}
        special |= {"options": options_of(0), "growing_stages": GROWING_STAGES}
        special |= {"discovers_in": "all stages but the last"}
    if arm in PROPOSED:
        special |= {"groups": "proposed", "walks": WALKS, "longest_walk": LONGEST_WALK}
    if arm in (*RANDOM, *CONTRASTING):
        special |= {"subgoals": "drawn" if arm in RANDOM else "drawn from what contrasts"}
    if arm in WITH_FEATURES:
        special |= {"observation": "with φ"}
    if arm in BONUS:
        special |= {f"{BONUS[arm]}_weight": WEIGHTS[BONUS[arm]]}
    if arm == ZOO_ARM:
        special |= {"ppo": zoo_settings(family), "n_envs": ZOO_N_ENVS, "normalised": True}
    return special
