"""The main job over many seeds: when is the first option made, and how far from the doorway is its subgoal?

``python -m experiments.discovery --runs 20 --out FOLDER`` trains DQN on the two-room gridworld with the defaults of
``train.py``, and writes ``results.json`` and ``discovery.png``. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast

import gymnasium as gym
import numpy as np
import tyro
from matplotlib import colormaps
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

import sb3_options.envs
from experiments.common.seeds import Result, run_seeds, write_json
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.config import DQNConfig
from sb3_options.runs.intervals import mean_interval, share_interval

NEAR = 1
"""A subgoal this many steps from the doorway still is at the doorway: every crossing visits it."""

EARLY = 60
"""An option that comes after this many episodes comes late."""

LAST_EPISODES = 20


@dataclass(frozen=True)
class Study:
    """Run the main job for many seeds and say where and when the first option was made.

    Attributes:
        out: Folder for results.json, discovery.png and one file per finished seed.
        runs: Number of seeds.
        first_seed: Seeds count up from here. The defaults of training were set on seeds 0 to 19, so none of these.
        n_timesteps: Primitive steps of each run; by default what training takes.
        jobs: Processes; by default one a core.
    """

    out: Annotated[Path, tyro.conf.arg(name="out")]
    runs: int = 20
    first_seed: int = 1000
    n_timesteps: int = DQNConfig.n_timesteps
    jobs: int | None = None


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    config = DQNConfig(n_timesteps=study.n_timesteps)
    results = run_seeds(
        partial(run, config),
        range(study.first_seed, study.first_seed + study.runs),
        study.out,
        settings=dataclasses.asdict(config),
        jobs=study.jobs,
        description="Training",
    )
    summary = summarise(results)
    command = f"python -m experiments.discovery --runs {study.runs} --first-seed {study.first_seed}"
    write_json(study.out / "results.json", {"command": command, **summary, "runs": results})
    draw(results).savefig(study.out / "discovery.png", dpi=110)
    _print(results, summary, study.out)


def run(config: DQNConfig, seed: int) -> Result:
    """Train once.

    Args:
        config: Of the run.
        seed: Replaces the configuration's.

    Returns:
        Of the first option: ``episode``, ``primitive_step``, ``subgoal`` cell and ``distance`` to the doorway in
        cells (all None if there is none); and ``final_steps``, the mean length of the last episodes.
    """
    config = dataclasses.replace(config, seed=seed)
    env = runs.make_env(config, config.n_envs, seed)
    model = make_model(config, env)
    discovery = SubgoalDiscoveryCallback(
        config.discovery, config.option, max_new_options=config.max_new_options, seed=seed
    )
    model.learn(config.n_timesteps, callback=discovery)
    lengths = [int(episode["l"]) for episode in (model.ep_info_buffer or [])]
    final = float(np.mean(lengths[-LAST_EPISODES:])) if lengths else None
    result: Result = {"seed": seed, "episodes": discovery.episodes, "final_steps": final}
    if not discovery.discoveries:
        return {**result, "episode": None, "primitive_step": None, "subgoal": None, "distance": None}
    first = discovery.discoveries[0]
    cell = [round(float(x)) for x in first.subgoal]
    return {
        **result,
        "episode": first.episode,
        "primitive_step": first.timestep,
        "subgoal": cell,
        "distance": _distance_to_doorway(config.env, cell),
    }


def _distance_to_doorway(env_id: str, cell: list[int]) -> int:
    world = cast("sb3_options.envs.GridWorld", gym.make(env_id).unwrapped)
    return min(abs(cell[0] - x) + abs(cell[1] - y) for x, y in world.doorways)


def summarise(results: list[Result]) -> dict[str, Any]:
    """How many of the runs made their first option near the doorway, and early."""
    good = [r["distance"] is not None and r["distance"] <= NEAR and r["episode"] < EARLY for r in results]
    found = [r for r in results if r["episode"] is not None]
    share = share_interval(sum(good), len(results))
    summary: dict[str, Any] = {
        "n_runs": len(results),
        "n_near_and_early": sum(good),
        "share_near_and_early": share._asdict(),
        "n_with_option": len(found),
    }
    if found:
        summary["median_episode"] = float(np.median([r["episode"] for r in found]))
        summary["median_primitive_step"] = float(np.median([r["primitive_step"] for r in found]))
    final = np.array([r["final_steps"] for r in results if r["final_steps"] is not None])
    if len(final):
        summary["final_steps"] = mean_interval(final)._asdict()
    return summary


def draw(results: list[Result]) -> Figure:
    """Where the first subgoals fell on the map, and when."""
    world = sb3_options.envs.GridWorld()
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    where, when = figure.subplots(1, 2, width_ratios=(2, 1))
    found = [r for r in results if r["subgoal"] is not None]
    counts = np.zeros((world.height, world.width))
    for r in found:
        counts[r["subgoal"][1], r["subgoal"][0]] += 1
    colours = colormaps["viridis"].with_extremes(bad="0.25")
    image = where.imshow(np.where(world.walls, np.nan, counts), cmap=colours, vmin=0)
    figure.colorbar(image, ax=where, shrink=0.7, label="runs")
    for x, y in world.doorways:
        where.plot(x, y, "s", markersize=13, markerfacecolor="none", markeredgecolor="#d62728")
    where.set_title(f"first subgoal of {len(found)} of {len(results)} runs (doorway framed)")
    when.hist([r["episode"] for r in found], bins=range(0, EARLY + 5, 4), color="#4292c6", edgecolor="white")
    when.axvline(EARLY, color="#d62728", linewidth=1)
    when.set_xlabel("episode of the first option")
    when.set_ylabel("runs")
    return figure


def _print(results: list[Result], summary: dict[str, Any], out: Path) -> None:
    table = Table("seed", "episode", "primitive step", "subgoal", "cells from doorway", "final steps/episode")
    for r in results:
        cells = [r[k] for k in ("seed", "episode", "primitive_step", "subgoal", "distance", "final_steps")]
        table.add_row(*("–" if c is None else str(c) for c in cells))
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    share = summary["share_near_and_early"]
    console.print(
        f"{summary['n_near_and_early']} of {summary['n_runs']} runs made their first option within {NEAR} cell of the "
        f"doorway before episode {EARLY} (95 % interval {share['low']:.2f} to {share['high']:.2f})."
    )
    console.print(f"Results: {out / 'results.json'}, {out / 'discovery.png'}")


if __name__ == "__main__":
    main(tyro.cli(Study))
