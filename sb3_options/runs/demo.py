"""The demonstration: discover an option, move the goal, and train with the option and without."""

import json
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from sb3_contrib.common.maskable.evaluation import evaluate_policy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EveryNTimesteps
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.callbacks import DiscoveredOption
from sb3_options.experience.success import learned_at
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.commands import EVAL_SEED, DemoConfig
from sb3_options.runs.config import TrainConfig, configure, shipped
from sb3_options.runs.folder import make_env
from sb3_options.runs.training import discovery_callback, use_one_thread
from sb3_options.runs.video import RecordFrames, captioned, write_beside

LEARNED = 0.9  # an agent has learned the task when two evaluations in a row reach this success rate

EVALUATION_EPISODES = 20
FILM_EPISODES = 3
FILM_FPS = 12.0

Result: TypeAlias = dict[str, Any]  # one training in the target, as in ``demo.json``

WITH, WITHOUT = "with the option", "without"
COLOURS = {WITH: "#d62728", WITHOUT: "0.45"}


class Claim(NamedTuple):
    """A pair of tasks with a common bottleneck: options are discovered in the source and used in the target."""

    first: str  # description of the source, for people
    second: str  # description of the target
    source: dict[str, Any]  # settings of the first task
    target: dict[str, Any]  # settings of the second task
    evaluate_every: int  # primitive steps between evaluations
    cells: tuple[int, int] | None = None  # columns and rows of a map to mark subgoals in; None if it changes


CLAIMS = {name: Claim(**claim) for name, claim in shipped("demo.yml").items()}


def show_demo(config: DemoConfig, console: Console) -> None:
    """Run the demonstration, print its table, and write ``demo.png`` and ``demo.json``."""
    use_one_thread()
    claim = CLAIMS[config.task]
    config.out.mkdir(parents=True, exist_ok=True)
    results: list[Result] = []
    found: list[list[DiscoveredOption]] = []
    films: list[list[Any]] = []
    console.print(f"1. {claim.first}\n2. {claim.second}")
    for seed in range(config.seed, config.seed + config.seeds):
        path = config.out / f"options-{seed}.safetensors"
        found.append(_discover(claim, seed, path, progress=config.progress))
        subgoals = "; ".join(option.where for option in found[-1]) or "none"
        for arm, file in ((WITH, path), (WITHOUT, None)):
            model, learning = _learn(claim, seed, file, progress=config.progress)
            results.append({"seed": seed, "arm": arm, "subgoals": subgoals, **learning})
            if config.video and seed == config.seed:
                films.append([captioned(picture, arm) for picture in _play(claim, seed, file, model)])
    console.print(table_of(results))
    numbers = json.dumps(sorted(results, key=lambda each: each["arm"] == WITHOUT), indent=2)
    (config.out / "demo.json").write_text(numbers + "\n", encoding="utf-8")
    picture = config.out / "demo.png"
    figure_of(results, claim, found[0], _play(claim, config.seed)[0]).savefig(picture, dpi=110)
    console.print(f"Picture: {picture}")
    if config.video:
        write_beside(config.out / "demo.gif", FILM_FPS, films)
        console.print(f"Film:    {config.out / 'demo.gif'}")
    console.print("Now in your environment: sb3-options train --env YOUR-ENV-ID   (or the lines in README)")


class _Evaluations(MaskableEvalCallback):
    """Plays the same greedy episodes each time, and ends training once the task is learned."""

    def __init__(self, eval_env: VecEnv, seed: int) -> None:
        super().__init__(eval_env, n_eval_episodes=EVALUATION_EPISODES, eval_freq=1, verbose=0)
        self.seed = seed
        self.steps: list[int] = []
        self.success: list[float] = []

    def _on_step(self) -> bool:
        self.eval_env.seed(self.seed)
        super()._on_step()
        self.steps.append(self.num_timesteps)
        self.success.append(float(np.mean(self._is_success_buffer)))
        return self.learned() is None

    def learned(self) -> int | None:
        """Return the primitive steps after which the task was learned, or None."""
        first = learned_at([rate >= LEARNED for rate in self.success])
        return None if first is None else self.steps[first]


def _target(claim: Claim, seed: int, options: Path | None) -> TrainConfig:
    """Return the default settings of ``sb3-options train``, with the options of a file or without options."""
    return configure(algo="maskableppo", **claim.target, seed=seed, options=options, max_new_options=0)


def _discover(claim: Claim, seed: int, options: Path, *, progress: bool) -> list[DiscoveredOption]:
    """Train in the source, and save the discovered options."""
    config = configure(algo="maskableppo", **claim.source, seed=seed)
    with closing(make_env(config, config.n_envs, seed)) as env:
        discovery = discovery_callback(config)
        make_model(config, env).learn(config.n_timesteps, discovery, progress_bar=progress)
        discovery.bank.save(options)
        return discovery.discoveries


def _learn(claim: Claim, seed: int, options: Path | None, *, progress: bool) -> tuple[BaseAlgorithm, Result]:
    """Train in the target until it is learned. Return the agent, and steps and success rates of evaluations."""
    config = _target(claim, seed, options)
    with (
        closing(make_env(config, config.n_envs, seed)) as env,
        closing(make_env(config, EVALUATION_EPISODES, EVAL_SEED + seed)) as eval_env,
    ):
        evaluations = _Evaluations(eval_env, EVAL_SEED + seed)
        callbacks = [discovery_callback(config), EveryNTimesteps(claim.evaluate_every, evaluations)]
        model = make_model(config, env).learn(config.n_timesteps, callbacks, progress_bar=progress)
    found = {"learned_after": evaluations.learned(), "steps": evaluations.steps, "success": evaluations.success}
    return model, found


def _play(claim: Claim, seed: int, options: Path | None = None, model: BaseAlgorithm | None = None) -> list[Any]:
    """Return pictures of greedy episodes in the target; without an agent, of the first start."""
    pictures: list[Any] = []

    def record(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        return RecordFrames(env, pictures.append, FILM_EPISODES)

    config = _target(claim, seed, options)
    with closing(make_env(config, 1, EVAL_SEED + seed, beneath=record, render_mode="rgb_array")) as env:
        if model is None:
            env.reset()
        else:
            env.env_method("set_slots", expect_empty=options is None)
            evaluate_policy(model, env, FILM_EPISODES)  # type: ignore[arg-type]  # MaskablePPO
    return pictures


def table_of(results: Sequence[Result]) -> Table:
    """Make a table of primitive steps until the task is learned, with a row for each seed."""
    table = Table("seed", "subgoals discovered", *COLOURS, title="Primitive steps until 90 % of the episodes succeed")
    texts = [
        f"not within {each['steps'][-1]:,} (success rate {each['success'][-1]:.0%})"
        if each["learned_after"] is None
        else f"{each['learned_after']:,}"
        for each in results
    ]
    for i in range(0, len(results), 2):
        table.add_row(str(results[i]["seed"]), results[i]["subgoals"], *texts[i : i + 2])
    return table


def figure_of(results: Sequence[Result], claim: Claim, options: Sequence[DiscoveredOption], task: Any) -> Figure:
    """Draw learning curves, thin for each seed and thick for their mean, beside a picture of the target.

    The subgoals of the options are marked in the picture ``task``, (height, width, 3).
    """
    figure = Figure(figsize=(10.0, 3.4), layout="compressed")
    left, right = figure.subplots(1, 2)
    left.imshow(task)
    left.set_axis_off()
    left.set_title("the second task", fontsize="medium")
    if claim.cells is not None and options:
        size = np.array([task.shape[1], task.shape[0]]) / claim.cells
        cells = np.array([option.subgoal[:2] for option in options])  # column and row; with a key, also the key
        x, y = (cells + 0.5).T * size[:, None]
        left.plot(x, y, "*", color=COLOURS[WITH], markersize=14, label="discovered subgoal")
        left.legend(loc="lower right", fontsize="small")
    longest = claim.target["n_timesteps"]
    grid = np.linspace(0, longest, 61)
    for arm, colour in COLOURS.items():
        # Training ends once the task is learned, so the last success rate stands for the rest.
        own = [each for each in results if each["arm"] == arm]
        curves = [np.interp(grid, [0, *each["steps"]], [0.0, *each["success"]]) for each in own]
        for curve in curves:
            right.plot(grid, curve, color=colour, linewidth=0.8, alpha=0.4)
        right.plot(grid, np.mean(curves, axis=0), color=colour, linewidth=2.5, label=arm)
    right.set_title("success rate while training", fontsize="medium")
    right.set(xlabel="primitive steps", xlim=(0, longest * 1.02), ylim=(-0.02, 1.02))
    right.xaxis.set_major_formatter("{x:,.0f}")
    right.grid(alpha=0.3)
    right.legend(loc="center right", frameon=False)
    return figure
