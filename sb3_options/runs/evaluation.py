"""Evaluating a run: returns, success and primitive steps of greedy episodes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.atomic import atomic_write
from sb3_options.experience.option_run import OptionRun
from sb3_options.experience.recording import LONGEST_EPISODE
from sb3_options.experience.success import success_rule
from sb3_options.learning.saved_model import check_finite
from sb3_options.learning.value_snapshot import interrupt_options
from sb3_options.options.bank import OptionBank
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.commands import EvaluateConfig
from sb3_options.runs.config import OFF_POLICY, TrainConfig
from sb3_options.runs.intervals import Interval, mean_interval, share_interval
from sb3_options.runs.users_code import IMPORTING
from sb3_options.runs.video import RecordFrames, render_mode_of, video_file

VIDEO_EPISODES = 10
"""A video shows this many episodes at most."""


class Evaluation(NamedTuple):
    """Undiscounted return, share of successes and primitive steps of an episode, over ``episodes`` of them."""

    episodes: int
    mean_return: Interval
    success_rate: Interval
    steps: Interval

    def intervals(self) -> dict[str, Interval]:
        """The three of them, by what one calls them."""
        return {"return": self.mean_return, "success rate": self.success_rate, "primitive steps": self.steps}


def table(result: Evaluation, run: str) -> Table:
    """The result as text; ``run`` names the evaluated run."""
    rows = Table("", "mean", "95 % confidence interval", title=f"{run}: {result.episodes} episodes")
    for name, interval in result.intervals().items():
        rows.add_row(name, f"{interval.mean:.3f}", f"{interval.low:.3f} to {interval.high:.3f}")
    return rows


def show_evaluation(config: EvaluateConfig, console: Console) -> Evaluation:
    """Evaluate a run, print the result, and write it to ``evaluation.json`` in the run folder if that is possible."""
    result = evaluate_run(**asdict(config))
    console.print(table(result, escape(str(config.run))))
    file = config.run / "evaluation.json"
    found = {name.replace(" ", "_"): interval._asdict() for name, interval in result.intervals().items()}
    content = json.dumps({"episodes": result.episodes, "seed": config.seed, **found}, indent=2)
    try:
        with atomic_write(file) as temporary:
            temporary.write_text(content + "\n", encoding="utf-8")
    except OSError as error:  # as of a run that belongs to somebody else
        why = escape(f"{file} cannot be written: {error.strerror or error}.")
        console.print(f"[yellow]Not kept:[/] {why} Evaluate a copy of the run folder to keep the result.")
    if config.video is not None:
        console.print(f"Video: {escape(str(config.video))}")
    return result


def greedy_episodes(
    model: BaseAlgorithm,
    venv: VecEnv,
    episodes: int,
    *,
    masked: bool = False,
    explore: Callable[[Any], Any] | None = None,
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Act greedily.

    Every environment plays its share of the episodes, so that short ones are not preferred.
    """
    left = [(episodes + i) // venv.num_envs for i in range(venv.num_envs)]
    steps = [0] * venv.num_envs
    observations, memory, starts = venv.reset(), None, np.ones(venv.num_envs, dtype=bool)
    while any(left):
        masks = {"action_masks": np.stack(venv.env_method("action_masks"))} if masked else {}
        # Only recurrent models have a memory, and ask where episodes start.
        actions, memory = model.predict(observations, memory, starts, deterministic=True, **masks)  # type: ignore[arg-type]  # a batch, as reset gives it
        observations, _, starts, infos = venv.step(actions if explore is None else explore(actions))
        for i, info in enumerate(infos):
            steps[i] += OptionRun.from_info(info).duration if "option" in info else 1
            if starts[i]:
                steps[i] = 0
                if left[i]:
                    left[i] -= 1
                    yield i, info
            elif left[i] and steps[i] >= LONGEST_EPISODE:
                raise ValueError(
                    f"An episode has not ended after {steps[i]:,} primitive steps: only episodes that end can be "
                    "evaluated. Give the environment a time limit in env_kwargs, those of a run in its config.yml."
                )


def evaluate_run(run: Path, **settings: Any) -> Evaluation:
    """Load a run folder and act greedily in its environment, with options interrupted as in training.

    Weights and options are read as arrays only; nothing in the folder can run code.
    """
    asked = EvaluateConfig(run, **settings)
    if asked.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, got {asked.episodes}.")
    model = runs.BEST if asked.best else runs.MODEL
    if asked.best and (run / runs.CONFIG).is_file() and not (run / model).is_file():
        raise FileNotFoundError(f"{run} has no {model}: train with --eval-freq, which keeps it.")
    _check_complete(run, model)
    if asked.video is not None and asked.video.suffix.lower() not in (".mp4", ".gif"):
        raise ValueError(f"--video must end in .mp4 or .gif, got {asked.video}.")
    trusted = {name: getattr(asked, name) for name in IMPORTING}
    # What the run started with is in its own options file, too.
    config = replace(configs.load(run / runs.CONFIG, trusted), options=None)
    runs.check_env_id(config.env)
    if asked.video is not None:
        mode, fps = render_mode_of(config.env, config.env_kwargs)
        with video_file(asked.video, fps) as film:
            _play(run / model, config, min(asked.episodes, VIDEO_EPISODES), asked.seed, film, mode)
    return _play(run / model, config, asked.episodes, asked.seed)


def _check_complete(run: Path, model: str) -> None:
    """Refuse a folder that lacks a file."""
    for name in (runs.CONFIG, model, runs.OPTIONS):
        if not (run / name).is_file():
            what = f"{run} is no run folder" if name == runs.CONFIG else f"The training of {run} was cut off"
            raise FileNotFoundError(f"{what}: it lacks {name}. `resume` goes on from a checkpoint, if there is one.")


def _play(
    saved: Path,
    config: TrainConfig,
    episodes: int,
    seed: int,
    film: Callable[[Any], None] | None = None,
    mode: str | None = None,
) -> Evaluation:
    cameras: list[RecordFrames] = []

    def record(env: gym.Env[Any, Any]) -> RecordFrames:
        assert film is not None  # it is not called then
        cameras.append(RecordFrames(env, film, episodes))
        return cameras[0]

    beneath = None if film is None else record
    with closing(runs.make_env(config, 1, seed, beneath=beneath, render_mode=mode)) as venv:
        for camera in cameras:
            camera.caption = venv.get_attr("running_option")[0]
        model = make_model(config, venv, playing=True)
        venv.seed(seed)  # the model has seeded it with the training seed
        # set_parameters reads tensors only, where load would unpickle.
        try:
            model.set_parameters(str(saved), device=model.device)
        except (RuntimeError, ValueError, UnpicklingError) as error:
            # torch has a heading, and a line for every array.
            first = next((line.strip() for line in str(error).splitlines() if line.startswith("\t")), error)
            raise ValueError(f"{saved} is damaged, or does not fit {saved.with_name(runs.CONFIG)}: {first}") from error
        check_finite(model, saved)
        bank: OptionBank = venv.get_attr("bank")[0]
        bank.load(saved.with_name(runs.OPTIONS) if saved.name == runs.MODEL else saved)
        if not bank.filled:
            venv.env_method("set_slots", expect_empty=True)  # the model has no others, so nothing is missing
        if config.algo in OFF_POLICY:
            interrupt_options(model, venv)
        venv.env_method("set_slots", record=True)
        played = greedy_episodes(model, venv, episodes, masked=config.algo == "maskableppo")
        found, succeeded = [], success_rule(config.success)
        for _, info in track(played, "Evaluating", total=episodes, transient=True):
            trajectory = info["trajectory"]
            found.append((float(trajectory.rewards.sum()), succeeded(trajectory), float(len(trajectory))))
    returns, successes, steps = zip(*found, strict=True)
    return Evaluation(
        episodes,
        mean_interval(np.array(returns)),
        share_interval(sum(successes), episodes),
        mean_interval(np.array(steps)),
    )
