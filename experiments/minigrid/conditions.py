"""What is run for every seed: an agent through the stages of a family."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from experiments.common.seeds import Result
from experiments.minigrid import settings
from experiments.minigrid.agents import Chooser, Notes, learned, model_of, normalised, success_rate, uniform, venv_of
from experiments.minigrid.hand_made import MadeBy, options_on, to_subgoals_on
from experiments.minigrid.random_grouped import RandomGrouped
from experiments.minigrid.settings import FAMILIES, WITH_OPTIONS, ZOO_ARM, Arm, Stage, Tuned, zoo_settings
from sb3_options.callbacks import (
    DiscoveredOption,
    IntrinsicRewardCallback,
    PrimitiveStepsCallback,
    SubgoalDiscoveryCallback,
)
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.proposed import propose_groups

Judged = Literal["sampled", "greedy", "uniform"]
JUDGED: tuple[Judged, ...] = get_args(Judged)
"""The policy, with actions sampled or the likeliest, and a uniform choice among options and primitives."""

SEEDS_APART = 100
"""Between two runs: environments of one run count on from its seed."""

FRESH = 10_000_000
"""Seeds of evaluations lie this far from those of training."""


def stages_of(family: str, arm: Arm) -> tuple[Stage, ...]:
    """The stages that an agent goes through."""
    stages = FAMILIES[family]
    if arm != "stock":
        return stages
    return (Stage(stages[-1].env_id, sum(stage.frames for stage in stages)),)


@dataclass(frozen=True)
class Protocol:
    """When stages end, and which policies are judged.

    Attributes:
        learned: A stage before the last ends when this share of the last episodes succeeded, if it has not used up its
            frames before; None: each uses them up.
        until: Likewise the last one, once every environment has had time for the longest episode.
        judged: Policies that play fresh episodes in the end.
    """

    learned: float | None = None
    until: float | None = None
    judged: Sequence[Judged] = JUDGED


def run(family: str, arm: Arm, protocol: Protocol, seed: int, *, tuned: Tuned | None = None) -> Result:
    """Train once through the stages.

    Args:
        family: A key of `FAMILIES`.
        arm: Which agent.
        protocol: When stages end, and what is judged.
        seed: Of model, environments and discovery.
        tuned: Settings that replace the study's.

    Returns:
        ``stages``: of each the ``curve`` of training success by primitive steps of the stage, ``option_runs`` by name
        and ending, ``frames``, ``seconds`` by the clock, ``processor_seconds``; ``success`` of the policy, sampled and
        greedy, in fresh episodes after the last stage, and, where there are options, of a ``uniform`` choice among
        them and the primitives; ``options``: the discovered ones.
    """
    env_seed = seed * SEEDS_APART
    ppo = settings.tuned_of(arm, tuned)
    weight = ppo.pop("weight", None)
    model: Any = None
    result: Result = {"seed": seed, "stages": [], "options": []}
    slots = settings.max_options(family) if arm in WITH_OPTIONS else 0
    n_envs = settings.ZOO_N_ENVS if arm == ZOO_ARM else settings.N_ENVS
    how: dict[str, Any] = {"n_envs": n_envs, "slots": slots, "by_hand": _by_hand(arm)}
    how |= {"with_features": arm in settings.WITH_FEATURES, "with_map": arm in settings.WITH_MAP}
    stages = stages_of(family, arm)
    before: VecEnv | None = None
    groups: Sequence[FeatureGroup] | None = None
    walked = 0
    with tempfile.TemporaryDirectory() as folder:
        for number, stage in enumerate(stages):
            is_last = number == len(stages) - 1
            n_rehearsed = stage.rehearsed * n_envs // settings.N_ENVS
            venv = venv_of(
                stage.env_id,
                env_seed,
                rehearsed=(stages[number - 1].env_id if n_rehearsed else "", n_rehearsed),
                **how,
            )
            if arm == ZOO_ARM:
                venv = before = normalised(venv, before)
            if model is None:
                model = model_of(arm, venv, env_seed, zoo_settings(family) if arm == ZOO_ARM else ppo)
            else:
                model.set_env(venv)
            longest = n_envs * venv.get_attr("unwrapped", [0])[0].max_steps
            learned_at, least = (protocol.until, longest) if is_last else (protocol.learned, 0)
            notes = Notes(n_envs - n_rehearsed, learned_at, least)
            rollouts = settings.primitive_rollouts(stage)
            began, worked = time.perf_counter(), time.process_time()
            if number == 0 and arm in settings.PROPOSED:
                groups, walked = _proposed(venv, env_seed)
            callbacks = callbacks_of(
                arm, seed, number, groups, is_last=is_last, primitive_rollouts=rollouts, weight=weight
            )
            model.learn(stage.frames, callback=[*callbacks, notes])
            taken = {"seconds": time.perf_counter() - began, "processor_seconds": time.process_time() - worked}
            runs = {name: dict(ends) for name, ends in notes.runs.items()}
            result["stages"].append({"curve": notes.curve, "option_runs": runs, **taken})
            result["stages"][-1]["frames"] = model.num_timesteps + (0 if number else walked)
            for found in callbacks:
                if isinstance(found, SubgoalDiscoveryCallback):
                    result["options"] += [_about(found, discovery, number) for discovery in found.discoveries]
                    seconds = found.discovery.diary.seconds if found.discovery else 0.0
                    result["stages"][-1]["discovery_seconds"] = seconds
                    how["options"] = Path(folder) / "options"
                    found.bank.save(how["options"])
            venv.close()
        fresh = env_seed + FRESH
        venv = venv_of(stages[-1].env_id, fresh, **how)
        if arm == ZOO_ARM:
            venv = normalised(venv, before, training=False)
        result["success"] = _judged(
            model, venv, fresh, protocol.judged if slots else [how for how in protocol.judged if how != "uniform"]
        )
    return result


def _by_hand(arm: Arm) -> MadeBy | None:
    if arm in settings.HAND_MADE:
        return partial(to_subgoals_on, within=settings.HAND_MADE[arm])
    return options_on if arm == "hand-made" else None


def _proposed(venv: VecEnv, seed: int) -> tuple[Sequence[FeatureGroup], int]:
    """Groups of features proposed from random walks, and the primitive steps of these."""
    walks = venv.env_method("random_trajectories", settings.WALKS, settings.LONGEST_WALK, seed, indices=[0])[0]
    features = [venv.env_method("concept_features", each.states, indices=[0])[0][each.visits] for each in walks]
    return propose_groups(features, venv.get_attr("feature_names", [0])[0]), sum(map(len, walks))


def callbacks_of(
    arm: Arm,
    seed: int,
    stage: int,
    groups: Sequence[FeatureGroup] | None,
    *,
    is_last: bool,
    primitive_rollouts: bool,
    weight: float | None = None,
) -> list[BaseCallback]:
    """Callbacks of an agent in one stage: discovery, options by hand, the bonus."""
    callbacks: list[BaseCallback] = []
    if arm in settings.DISCOVERING:
        is_drawn = arm in (*settings.RANDOM, *settings.CONTRASTING)
        drawn = RandomGrouped(contrasting=arm in settings.CONTRASTING, seed=seed) if is_drawn else None
        discovery = SubgoalDiscoveryCallback(
            settings.WITHOUT_GROUPS if arm in settings.WITH_MAP else settings.DISCOVERY,
            settings.options_of(stage),
            method=drawn,
            max_new_options=0 if is_last and stage else None,
            concepts={"groups": groups},
            use={"max_option_exploration": settings.OPENING_SHARE, "primitive_rollouts": primitive_rollouts},
        )
        callbacks.append(discovery)
    if arm == "hand-made" or arm in settings.HAND_MADE:
        callbacks.append(PrimitiveStepsCallback(primitive_rollouts=primitive_rollouts))
    over = (stage and arm in settings.BONUS_AT_FIRST) or (is_last and arm in settings.BONUS_BEFORE_LAST)
    if arm in settings.BONUS and not over:
        kind = settings.BONUS[arm]
        callbacks.append(IntrinsicRewardCallback(kind, weight=weight or settings.WEIGHTS[kind], seed=seed))
    return callbacks


def _about(callback: SubgoalDiscoveryCallback, found: DiscoveredOption, stage: int) -> dict[str, Any]:
    return {
        "where": found.where,
        "stage": stage,
        "frames": found.timestep,
        "initiation_points": found.initiation_states,
        "closed": any(found.slot == closed.slot and closed.timestep > found.timestep for closed in callback.closed),
    }


def _judged(model: Any, venv: VecEnv, seed: int, policies: Sequence[Judged]) -> dict[str, float]:
    choosers: dict[Judged, Chooser] = {
        "sampled": learned(model, deterministic=False),
        "greedy": learned(model, deterministic=True),
        "uniform": uniform(seed),
    }
    success: dict[str, float] = {how: success_rate(choosers[how], venv, seed) for how in policies}
    venv.close()
    return success
