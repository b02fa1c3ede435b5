"""Evaluates a run by return, success rate and primitive steps."""

import json
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.atomic import atomic_write
from sb3_options.experience.success import success_rule
from sb3_options.learning.saved_model import check_finite
from sb3_options.options.bank import OptionBank
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.commands import EvaluateConfig
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.intervals import Interval, mean_interval, share_interval
from sb3_options.runs.video import RecordFrames, render_mode_of, video_file

VIDEO_EPISODES = 10  # maximum number of episodes in a video


class Evaluation(NamedTuple):
    """Undiscounted return, success rate and primitive steps per episode, over ``episodes`` episodes."""

    episodes: int
    mean_return: Interval
    success_rate: Interval
    steps: Interval


def show_evaluation(config: EvaluateConfig, console: Console) -> None:
    """Evaluate a run, print the result, and write it to ``evaluation.json`` in the run folder."""
    result = evaluate_run(**asdict(config))
    intervals = {"return": result.mean_return, "success rate": result.success_rate, "primitive steps": result.steps}
    how = "sampled actions" if config.stochastic else "greedy actions"
    title = f"{escape(str(config.run))}: {result.episodes} episodes, {how}"
    table = Table("", "mean", "95 % confidence interval", title=title)
    for name, interval in intervals.items():
        table.add_row(name, f"{interval.mean:.3f}", f"{interval.low:.3f} to {interval.high:.3f}")
    console.print(table)
    found = {name.replace(" ", "_"): interval._asdict() for name, interval in intervals.items()}
    content = json.dumps(
        {"episodes": result.episodes, "seed": config.seed, "stochastic": config.stochastic, **found}, indent=2
    )
    with atomic_write(config.run / "evaluation.json") as temporary:
        temporary.write_text(content + "\n", encoding="utf-8")


def evaluate_run(run: Path, **settings: Any) -> Evaluation:
    """Load a run folder and play its model, by default greedily.

    Weights and options are read as arrays only; nothing in the folder can run code.
    """
    asked = EvaluateConfig(run, **settings)
    model = runs.BEST if asked.best else runs.MODEL
    for name in (runs.CONFIG, model, runs.OPTIONS):
        (run / name).stat()  # a missing file is named before an environment is made
    # The run's own options file also holds the options that it started with.
    config = replace(configs.load(run / runs.CONFIG, asked.trusted()), options=None)
    if asked.stochastic and config.algo in configs.OFF_POLICY:
        raise ValueError(f"The policy of {config.algo} is greedy and samples no actions: leave --stochastic out.")
    cameras: list[RecordFrames] = []
    with ExitStack() as stack:

        def filmed(env: gym.Env[Any, Any]) -> RecordFrames:
            cameras.append(RecordFrames(env, film, min(asked.episodes, VIDEO_EPISODES)))
            return cameras[0]

        mode = None
        if asked.video is not None:
            mode, fps = render_mode_of(config)
            film = stack.enter_context(video_file(asked.video, fps))
        beneath = None if mode is None else filmed
        venv = stack.enter_context(closing(runs.make_env(config, 1, asked.seed, beneath=beneath, render_mode=mode)))
        for camera in cameras:
            camera.caption = venv.get_attr("running_option")[0]
        return _play(run / model, config, venv, asked)


def _play(saved: Path, config: TrainConfig, venv: VecEnv, asked: EvaluateConfig) -> Evaluation:
    """Play a saved model in an environment."""
    model = make_model(config, venv, playing=True)
    venv.seed(asked.seed)  # the model has set the training seed
    # set_parameters reads tensors only, where load would unpickle.
    try:
        model.set_parameters(str(saved), device=model.device)
    except (RuntimeError, ValueError, UnpicklingError) as error:
        # torch's message has a heading, and a line for every array.
        first: object = next((line.strip() for line in str(error).splitlines() if line.startswith("\t")), error)
        if isinstance(error, UnpicklingError):
            first = "its weights are damaged, or hold Python objects, which are not read."
        raise ValueError(f"{saved} is damaged, or does not fit {saved.with_name(runs.CONFIG)}: {first}") from error
    check_finite(model, saved)
    bank: OptionBank = venv.get_attr("bank")[0]
    bank.load(saved.with_name(runs.OPTIONS) if saved.name == runs.MODEL else saved)
    if not bank.filled:
        venv.env_method("set_slots", expect_empty=True)  # the model has no options, so nothing is missing
    venv.env_method("set_slots", record=True)
    found: list[tuple[float, bool, float]] = []
    succeeded = success_rule(config.success)

    def keep(variables: dict[str, Any], _: dict[str, Any]) -> None:
        if variables["done"]:
            trajectory = variables["info"]["trajectory"]
            found.append((float(trajectory.rewards.sum()), succeeded(trajectory), float(len(trajectory))))

    play: Callable[..., Any] = evaluate_policy
    if config.algo == "maskableppo":
        from sb3_contrib.common.maskable.evaluation import evaluate_policy as play
    play(model, venv, asked.episodes, deterministic=not asked.stochastic, callback=keep)
    returns, successes, steps = zip(*found, strict=True)
    return Evaluation(
        asked.episodes,
        mean_interval(np.array(returns)),
        share_interval(sum(successes), asked.episodes),
        mean_interval(np.array(steps)),
    )
