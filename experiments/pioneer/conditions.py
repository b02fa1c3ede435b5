"""What is run for every seed: the main task with and without discovery, and the other tasks with its option."""

from __future__ import annotations

from pathlib import Path

from experiments.pioneer.agents import discoverer, evaluate, live, make_agent, wrapper_of
from experiments.pioneer.settings import MAIN_TASK, TASKS, PioneerSettings
from experiments.seeds import Result
from sb3_options.atomic import whole_file

EVALUATION_SEED = 10_000
"""Added to a run's seed for the trials in which it is evaluated."""


def learning(settings: PioneerSettings, artifacts: Path, seed: int) -> Result:
    """The main task: primitives only, and with discovery.

    Up to the trial in which the option is made the two are the same agent, bit for bit.
    """
    result: Result = {}
    for name, max_new_options in (("primitive", 0), ("discovery", settings.options_per_run)):
        agent = make_agent(settings, MAIN_TASK, seed)
        callback = discoverer(settings, seed, max_new_options=max_new_options)
        result[name] = live(agent, settings.trials, callback)
        result[f"{name}_evaluation"] = evaluate(
            agent, settings.evaluation_trials, settings.evaluation_epsilon, EVALUATION_SEED + seed
        )
        if name == "discovery":
            found = callback.discoveries[0] if callback.discoveries else None
            result["option"] = {
                "trial": None if found is None else found.episode,
                "timestep": None if found is None else found.timestep,
                "displacement": None if found is None else float(found.subgoal[0]),
                "width": None if found is None else float(found.subgoal[1]),
            }
            file = _file(artifacts, seed)
            file.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(file) as temporary:
                callback.bank.save(temporary)
        agent.env.close()  # type: ignore[union-attr]  # made with one
    return result


def transfer(settings: PioneerSettings, artifacts: Path, seed: int) -> Result:
    """The other tasks: primitives only, and with the option that the same seed found in the main task."""
    result: Result = {}
    for task, env_id in TASKS.items():
        result[task] = {}
        for name in ("primitive", "option"):
            agent = make_agent(settings, env_id, seed)
            if name == "option":
                wrapper_of(agent).bank.load(_file(artifacts, seed))
            result[task][name] = live(agent, settings.transfer_trials, discoverer(settings, seed, max_new_options=0))
            agent.env.close()  # type: ignore[union-attr]  # made with one
    return result


def _file(artifacts: Path, seed: int) -> Path:
    return artifacts / f"{seed}.safetensors"
