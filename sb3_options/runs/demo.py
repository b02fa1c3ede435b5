"""The demonstration: discover an option, move the goal, and train with the option and without."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.atomic import atomic_write
from sb3_options.callbacks import DiscoveredOption
from sb3_options.experience.success import learned_at
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.budget import KeepToBudget
from sb3_options.runs.commands import EVAL_SEED, DemoConfig
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.evaluation import greedy_episodes
from sb3_options.runs.pictures import save_picture
from sb3_options.runs.training import discovery_callback
from sb3_options.runs.video import RecordFrames, captioned, video_file

ALGO = "maskableppo"

LEARNED = 0.9
"""Success rate of two evaluations in a row from which on an agent has learned the task."""

EVALUATION_EPISODES = 20

FILM_EPISODES = 3

FILM_FPS = 12.0
"""Pictures per second."""

GAP = 8
"""White pixels between the two agents of a film."""

WITH, WITHOUT = "with the option", "without"
COLOURS = {WITH: "#d62728", WITHOUT: "0.45"}


class Claim(NamedTuple):
    """A pair of tasks that share a bottleneck.

    Attributes:
        source: Settings of the task in which options are discovered.
        target: Settings of the task that is learned with them and without them.
        source_steps: Primitive steps of training in the source.
        target_steps: Most primitive steps of training in the target.
        evaluate_every: Primitive steps between evaluations.
        cells: Columns and rows of the map, in which subgoals are marked; None where every episode has another map.
        first: What happens in the source, for people.
        second: What happens in the target.
    """

    source: dict[str, Any]
    target: dict[str, Any]
    source_steps: int
    target_steps: int
    evaluate_every: int
    cells: tuple[int, int] | None
    first: str
    second: str


CLAIMS = {
    "rooms": Claim(
        source={"env": "sb3_options/TwoRooms-v0"},
        target={
            "env": "sb3_options/TwoRooms-v0",
            "env_kwargs": {"goal": [20, 0], "max_steps": 100, "success_probability": 0.8},
        },
        source_steps=20_000,
        target_steps=30_000,
        evaluate_every=1_000,
        cells=(21, 10),
        first="Two rooms, goal at the lower right. The agent discovers an option while it learns.",
        second="The goal moves to the upper right, one move in five goes astray, an episode ends after 100 steps.",
    ),
    "key": Claim(
        source={"env": "sb3_options/KeyDoor-v0", "max_new_options": None},
        target={
            "env": "sb3_options/KeyDoor-v0",
            "env_kwargs": {"goal": [12, 0], "max_steps": 150, "success_probability": 0.8},
        },
        source_steps=40_000,
        target_steps=30_000,
        evaluate_every=1_000,
        cells=(13, 8),
        first="A locked door, and a key. The agent discovers options while it learns.",
        second="The goal moves, one move in five goes astray, an episode ends after 150 steps.",
    ),
    "minigrid": Claim(
        source={"env": "MiniGrid-MultiRoom-N2-S4-v0"},
        target={"env": "MiniGrid-MultiRoom-N4-S5-v1"},
        source_steps=60_000,
        target_steps=200_000,
        evaluate_every=5_000,
        cells=None,
        first="MiniGrid, two small rooms. The agent discovers options while it learns.",
        second="Four larger rooms, at other places in every episode.",
    ),
}


Found: TypeAlias = list[list[DiscoveredOption]]
"""Options discovered in the source, for each seed."""


class Learning(NamedTuple):
    """One training in the target.

    Attributes:
        steps: Primitive steps before each evaluation.
        success: Success rate of each evaluation.
        model: The trained model.
    """

    steps: list[int]
    success: list[float]
    model: BaseAlgorithm


def show_demo(config: DemoConfig, console: Console) -> None:
    """Run the demonstration, print its table, and write ``demo.png``, ``demo.json`` and ``demo.gif``.

    Raises:
        ModuleNotFoundError: MiniGrid is not installed.
        OSError: A file cannot be written.
        ValueError: ``seeds`` is below 1.
    """
    if config.seeds < 1:
        raise ValueError(f"--seeds must be at least 1, got {config.seeds}.")
    claim = CLAIMS[config.task]
    config.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, list[Learning]] = {WITH: [], WITHOUT: []}
    found: Found = []
    console.print(f"1. {claim.first}\n2. {claim.second}")
    with Progress(console=console, transient=True, disable=not config.progress) as progress:
        whole = progress.add_task("Training", total=config.seeds * (claim.source_steps + 2 * claim.target_steps))
        for seed in range(config.seed, config.seed + config.seeds):
            options = config.out / f"options-{seed}.safetensors"
            found.append(_discover(claim, seed, options, progress, whole))
            for arm, file in ((WITH, options), (WITHOUT, None)):
                results[arm].append(_learn(claim, seed, file, progress, whole))
    console.print(table_of(results, found, config.seed))
    with atomic_write(config.out / "demo.json") as temporary:
        temporary.write_text(json.dumps(_numbers(results, found, config.seed), indent=2) + "\n", encoding="utf-8")
    picture = config.out / "demo.png"
    save_picture(figure_of(results, claim, found[0], _pictures(claim, config.seed, None, None)[0]), picture)
    console.print(f"Picture: {picture}")
    if config.video:
        film = config.out / "demo.gif"
        firsts = {arm: learnings[0] for arm, learnings in results.items()}
        _film(claim, config.seed, firsts, config.out / f"options-{config.seed}.safetensors", film)
        console.print(f"Film:    {film}")
    console.print("Now in your environment: sb3-options train --env YOUR-ENV-ID   (or the lines in README)")


class _Watch(BaseCallback):
    """Advances the progress bar by primitive steps."""

    def __init__(self, progress: Progress, task: TaskID) -> None:
        super().__init__()
        self._progress = progress
        self._task = task
        self._shown = 0

    def _on_step(self) -> bool:
        self._progress.advance(self._task, self.num_timesteps - self._shown)
        self._shown = self.num_timesteps
        return True


class _Evaluations(MaskableEvalCallback):
    """Plays greedy episodes, the same ones each time, and ends training once the task is learned.

    It is an ``EvalCallback``, hence the discovery callback keeps the options of ``eval_env`` up to date.
    """

    def __init__(self, eval_env: VecEnv, seed: int) -> None:
        super().__init__(eval_env)
        self.seed = seed
        self.steps: list[int] = []
        self.success: list[float] = []

    def _on_step(self) -> bool:
        self.eval_env.seed(self.seed)
        played = greedy_episodes(self.model, self.eval_env, EVALUATION_EPISODES, masked=True)
        self.steps.append(self.num_timesteps)
        self.success.append(float(np.mean([info["is_success"] for _, info in played])))
        return learned_after(self.steps, self.success) is None


def learned_after(steps: list[int], success: list[float]) -> int | None:
    """Primitive steps at which the task was learned (`learned_at`); None if it was not."""
    first = learned_at([rate >= LEARNED for rate in success])
    return None if first is None else steps[first]


def _config(
    values: Mapping[str, Any], n_timesteps: int, seed: int, options: Path | None = None, *, discover: bool = False
) -> TrainConfig:
    """The settings that ``sb3-options train`` has by default for a task."""
    return configs.configure(
        algo=ALGO, **values, n_timesteps=n_timesteps, seed=seed, options=options, discover=discover
    )


def _discover(claim: Claim, seed: int, options: Path, progress: Progress, task: TaskID) -> list[DiscoveredOption]:
    """Train in the source, and save the options that were discovered."""
    config = _config(claim.source, claim.source_steps, seed, discover=True)
    with closing(runs.make_env(config, config.n_envs, seed)) as env:
        discovery = discovery_callback(config)
        make_model(config, env).learn(config.n_timesteps, [discovery, KeepToBudget(), _Watch(progress, task)])
        discovery.bank.save(options)
        return discovery.discoveries


def _learn(claim: Claim, seed: int, options: Path | None, progress: Progress, task: TaskID) -> Learning:
    """Train in the target until it is learned, with the options of a file or with none."""
    config = _config(claim.target, claim.target_steps, seed, options)
    before = progress.tasks[task].completed
    with (
        closing(runs.make_env(config, config.n_envs, seed)) as env,
        closing(runs.make_env(config, EVALUATION_EPISODES, EVAL_SEED + seed)) as eval_env,
    ):
        evaluations = _Evaluations(eval_env, EVAL_SEED + seed)
        model = make_model(config, env)
        model.learn(
            config.n_timesteps,
            [
                discovery_callback(config),
                EveryNTimesteps(claim.evaluate_every, evaluations),
                KeepToBudget(),
                _Watch(progress, task),
            ],
        )
    progress.update(task, completed=before + claim.target_steps)
    return Learning(evaluations.steps, evaluations.success, model)


def table_of(results: Mapping[str, list[Learning]], found: Found, first_seed: int) -> Table:
    """Primitive steps until the task is learned, a row for each seed."""
    table = Table("seed", "subgoals discovered", *results, title="Primitive steps until 90 % of the episodes succeed")
    for i, options in enumerate(found):
        cells = [_steps_text(learnings[i]) for learnings in results.values()]
        table.add_row(str(first_seed + i), _subgoals_text(options), *cells)
    return table


def _subgoals_text(options: list[DiscoveredOption]) -> str:
    return "; ".join(option.where for option in options) or "none"


def _steps_text(learning: Learning) -> str:
    after = learned_after(learning.steps, learning.success)
    if after is None:
        return f"not within {learning.steps[-1]:,} (success rate {learning.success[-1]:.0%})"
    return f"{after:,}"


def _numbers(results: Mapping[str, list[Learning]], found: Found, first_seed: int) -> list[dict[str, Any]]:
    """The numbers behind the table and the picture."""
    return [
        {
            "seed": first_seed + i,
            "arm": arm,
            "subgoals": _subgoals_text(options),
            "learned_after": learned_after(each.steps, each.success),
            "steps": each.steps,
            "success": each.success,
        }
        for arm, learnings in results.items()
        for i, (options, each) in enumerate(zip(found, learnings, strict=True))
    ]


def figure_of(
    results: Mapping[str, list[Learning]], claim: Claim, options: list[DiscoveredOption], task: Any
) -> Figure:
    """The learning curves, thin for each seed and thick for their mean, beside a picture of the task.

    Args:
        results: The trainings of each arm.
        claim: Their tasks.
        options: Discovered in the source; their subgoals are marked.
        task: A picture of the target, (height, width, 3).
    """
    figure = Figure(figsize=(10.0, 3.4), layout="compressed")
    left, right = figure.subplots(1, 2)
    left.imshow(task)
    left.set_axis_off()
    left.set_title("the second task", fontsize="medium")
    if claim.cells is not None and options:
        size = np.array([task.shape[1], task.shape[0]]) / claim.cells
        cells = np.array(
            [option.subgoal[:2] for option in options]
        )  # column and row; on a map with a key, also the key
        x, y = (cells + 0.5).T * size[:, None]
        left.plot(x, y, "*", color=COLOURS[WITH], markersize=14, label="discovered subgoal")
        left.legend(loc="lower right", fontsize="small")
    right.set_title("success rate while training", fontsize="medium")
    _draw_curves(right, results, claim.target_steps)
    return figure


def _draw_curves(axes: Axes, results: Mapping[str, list[Learning]], longest: int) -> None:
    grid = np.linspace(0, longest, 61)
    for arm, learnings in results.items():
        # Training ends once the task is learned; the last success rate stands for the rest.
        curves = [np.interp(grid, [0, *each.steps], [0.0, *each.success]) for each in learnings]
        for curve in curves:
            axes.plot(grid, curve, color=COLOURS[arm], linewidth=0.8, alpha=0.4)
        axes.plot(grid, np.mean(curves, axis=0), color=COLOURS[arm], linewidth=2.5, label=arm)
    axes.set_xlabel("primitive steps")
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlim(0, longest * 1.02)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.grid(alpha=0.3)
    axes.legend(loc="center right", frameon=False)


def _pictures(claim: Claim, seed: int, learning: Learning | None, options: Path | None) -> list[Any]:
    """The pictures of greedy episodes; of the first state alone where there is no agent."""
    pictures: list[Any] = []
    config = _config(claim.target, claim.target_steps, seed, options)
    episodes = FILM_EPISODES if learning is not None else 1

    def record(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        return RecordFrames(env, pictures.append, episodes)

    with closing(runs.make_env(config, 1, EVAL_SEED + seed, beneath=record, render_mode="rgb_array")) as env:
        env.reset()
        if learning is None:
            return pictures[:1]
        pictures.clear()
        env.env_method("set_slots", expect_empty=options is None)
        list(greedy_episodes(learning.model, env, episodes, masked=True))
    return pictures


def _film(claim: Claim, seed: int, learnings: Mapping[str, Learning], options: Path, path: Path) -> None:
    """Write both agents side by side; the one that is done first waits in its last picture."""
    sides = []
    for arm, learning in learnings.items():
        pictures = _pictures(claim, seed, learning, options if arm == WITH else None)
        sides.append([captioned(picture, arm) for picture in pictures])
    longest = max(map(len, sides))
    height = sides[0][0].shape[0]
    gap = np.full((height, GAP, 3), 255, dtype=np.uint8)
    with video_file(path, FILM_FPS) as film:
        for i in range(longest):
            left, right = (side[min(i, len(side) - 1)] for side in sides)
            film(np.concatenate([left, gap, right], axis=1))
