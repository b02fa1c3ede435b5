"""What is run for every seed: an agent through the stages of a family."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from experiments.common.seeds import Result
from experiments.minigrid import settings
from experiments.minigrid.agents import Notes, learned, model_of, success_rate, uniform, venv_of
from experiments.minigrid.settings import FAMILIES, Arm, Stage
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.options.option import SubgoalOption

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


def run(family: str, arm: Arm, seed: int) -> Result:
    """Train once through the stages.

    Args:
        family: A key of `FAMILIES`.
        arm: Which agent.
        seed: Of model, environments and discovery.

    Returns:
        ``stages``: of each the ``curve`` of training success by primitive steps of the stage, ``option_runs`` by slot
        and ending, ``seconds``; ``success`` of the policy, sampled and greedy, in fresh episodes after the last stage,
        and, where there are options, of a ``uniform`` choice among them and the primitives; ``options``: the discovered
        ones.
    """
    env_seed = seed * SEEDS_APART
    model: Any = None
    result: Result = {"seed": seed, "stages": [], "options": []}
    slots = arm in ("discovered", "hand-made")
    with tempfile.TemporaryDirectory() as folder:
        file: Path | None = None
        for number, stage in enumerate(stages_of(family, arm)):
            venv = venv_of(stage.env_id, env_seed, options=file, hand_made=arm == "hand-made", slots=slots)
            if model is None:
                model = model_of(venv, env_seed, masked=slots)
            else:
                model.set_env(venv)
            notes = Notes()
            callbacks: list[BaseCallback] = [notes]
            if arm == "discovered":
                callbacks.insert(0, _discovery(number == 0, seed))
            elif arm == "hand-made":
                callbacks.insert(0, PrimitiveStepsCallback())
            began = time.perf_counter()
            model.learn(stage.frames, callback=callbacks)
            seconds = time.perf_counter() - began
            runs = {str(slot): dict(ends) for slot, ends in notes.runs.items()}
            result["stages"].append({"curve": notes.curve, "option_runs": runs, "seconds": seconds})
            if isinstance(callbacks[0], SubgoalDiscoveryCallback):
                if number == 0:
                    result["options"] = [_about(callbacks[0], d) for d in callbacks[0].discoveries]
                    result["stages"][0]["discovery_seconds"] = (
                        callbacks[0].discovery.seconds if callbacks[0].discovery else 0.0
                    )
                file = Path(folder) / "options"
                callbacks[0].bank.save(file)
            venv.close()
        task = stages_of(family, arm)[-1].env_id
        fresh = env_seed + FRESH
        venv = venv_of(task, fresh, options=file, hand_made=arm == "hand-made", slots=slots)
        result["success"] = _judged(model, venv, fresh, slots)
    return result


def _discovery(first: bool, seed: int) -> SubgoalDiscoveryCallback:
    return SubgoalDiscoveryCallback(
        settings.DISCOVERY,
        max_new_options=None if first else 0,
        opening_share=settings.OPENING_SHARE,
        seed=seed,
    )


def _about(callback: SubgoalDiscoveryCallback, found: Any) -> dict[str, Any]:
    option = callback.bank[found.slot]
    points = len(option.initiation_set.points) if isinstance(option, SubgoalOption) else 0
    return {"slot": found.slot, "where": found.where, "frames": found.timestep, "initiation_points": points}


def _judged(model: Any, venv: Any, seed: int, slots: bool) -> dict[str, float]:
    success = {
        "sampled": success_rate(learned(model, deterministic=False), venv, seed),
        "greedy": success_rate(learned(model, deterministic=True), venv, seed),
    }
    if slots:
        success["uniform"] = success_rate(uniform(seed), venv, seed)
    venv.close()
    return success
