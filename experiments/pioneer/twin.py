"""``python -m experiments.pioneer.twin --runs 5 --out FOLDER``: do options from PyBullet work in MuJoCo?

Every seed learns its option and its values in PyBullet, and nothing more after that. Then the same trials are played
in both simulators: the option alone, from starts in its initiation set until it ends, and the whole task. It leaves
results.json and a picture of both robots' ways. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.table import Table
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.turns import take_turns
from experiments.common.agents import live, wrapper_of
from experiments.common.documents import number
from experiments.common.intervals import ratio_interval
from experiments.common.seeds import Result, run_seeds
from experiments.common.study import Flags, show, write
from experiments.pioneer.agents import discoverer, evaluate, make_agent
from experiments.pioneer.conditions import EVALUATION_SEED
from experiments.pioneer.settings import MAIN_TASK, PioneerSettings
from sb3_options import OptionsWrapper
from sb3_options.envs.pioneer.env import PioneerTask
from sb3_options.runs.intervals import mean_interval, share_interval

SIMULATORS = {"PyBullet": MAIN_TASK, "MuJoCo": "sb3_options/PioneerMuJoCo-v0"}
"""Where the option was learned, and where it is taken to."""

COLOURS = {"PyBullet": "#1f77b4", "MuJoCo": "#ff7f0e"}

START_SEED = 100_000
"""Times a run's seed: the first seed of the starts from which its option is tried."""

MARGIN = 0.05
"""By how much success may differ."""

N_WAYS = 6
"""Ways in the picture: of the first seed, from the median of steps in PyBullet to the most, at equal ranks."""


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Options learned in PyBullet, tried in PyBullet and in MuJoCo.

    Attributes:
        runs: Number of seeds, each with an option of its own.
        trials: Of each option in each simulator, alone and in the whole task.
        options: Try the first option of this file instead of learning some; then there is no whole task.
        rounds: In which the simulators take turns when their speed is measured.
        settings: Of learning and of discovery.
    """

    runs: int = 5
    trials: int = 200
    options: Path | None = None
    rounds: int = 20
    settings: PioneerSettings = field(default_factory=PioneerSettings)


class RecordWay(gym.Wrapper[Any, Any, Any, Any]):
    """Notes where the robot is after every primitive step of an episode."""

    way: list[tuple[float, float]]

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin a way."""
        result = super().reset(**kwargs)
        self.way = [_place(self)]
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and note."""
        result = super().step(action)
        self.way.append(_place(self))
        return result


def learned(settings: PioneerSettings, n_trials: int, artifacts: Path, seed: int) -> Result:
    """An agent learns in PyBullet; then its option and its values are tried in both simulators."""
    agent = make_agent(settings, MAIN_TASK, seed)
    callback = discoverer(settings, seed, max_new_options=settings.options_per_run)
    live(agent, settings.trials, callback)
    if not callback.discoveries:
        raise ValueError(f"seed {seed} has learned no option: choose another --first-seed")
    artifacts.mkdir(parents=True, exist_ok=True)
    file = artifacts / f"{seed}.safetensors"
    callback.bank.save(file)
    result = alone(settings, n_trials, file, seed)
    for name, env_id in SIMULATORS.items():
        env = wrapper_of(make_agent(settings, env_id, seed))
        env.bank.load(file)
        agent.env.close()  # type: ignore[union-attr]  # made with one
        agent.set_env(DummyVecEnv([partial(_same, env)]))
        result[name]["task"] = evaluate(agent, n_trials, settings.evaluation_epsilon, EVALUATION_SEED + seed)
    agent.env.close()  # type: ignore[union-attr]  # made with one
    return result


def alone(settings: PioneerSettings, n_trials: int, file: Path, seed: int) -> Result:
    """The option of a file, from the same starts in both simulators.

    Starts are the environment's own, those of them in which the option may begin.
    """
    envs = {
        name: OptionsWrapper(
            RecordWay(gym.make(env_id, max_steps=settings.step_limit)), settings.options_per_run, options_file=file
        )
        for name, env_id in SIMULATORS.items()
    }
    result: Result = {name: {"reached": [], "steps": [], "ways": []} for name in SIMULATORS}
    result["starts"] = []
    start = START_SEED * seed
    while len(result["starts"]) < n_trials:
        for env in envs.values():
            env.reset(seed=start)
        if all(env.action_masks()[env.n_primitive] for env in envs.values()):
            core = envs["PyBullet"].unwrapped
            assert isinstance(core, PioneerTask)
            result["starts"].append({"seed": start, "ball": list(core.ball_positions[0])})
            for name, env in envs.items():
                ran = env.step(env.n_primitive)[4]["option"]
                result[name]["reached"].append(ran["termination"] == "subgoal")
                result[name]["steps"].append(ran["duration"])
                result[name]["ways"].append(env.get_wrapper_attr("way"))
        start += 1
    for env in envs.values():
        env.close()
    return result


def speed(rounds: int, actions: int = 100) -> dict[str, list[float]]:
    """Primitive steps per second, in turns; the same random actions in both simulators."""
    envs = {name: gym.make(env_id) for name, env_id in SIMULATORS.items()}

    def play(name: str) -> float:
        env = envs[name]
        spent = 0.0
        for _ in range(actions):
            action = env.action_space.sample()
            began = time.perf_counter()
            _, _, terminated, truncated, _ = env.step(action)
            spent += time.perf_counter() - began
            if terminated or truncated:
                env.reset()
        return actions / spent

    for env in envs.values():
        env.action_space.seed(0)
        env.reset(seed=0)
    found = take_turns(list(envs), play, rounds, description="Speed")
    for env in envs.values():
        env.close()
    return found


def main(study: Study) -> None:
    """Run it, and write and print what was found."""
    settings = study.settings
    function: Callable[[int], Result] = (
        partial(alone, settings, study.trials, study.options)
        if study.options is not None
        else partial(learned, settings, study.trials, study.out / "artifacts")
    )
    runs = run_seeds(
        function,
        study.seeds(),
        study.out,
        settings={"trials": study.trials, "options": study.options, **settings.described()},
        on=study,
        description="Twin",
    )
    numbers = numbers_of(runs, speed(study.rounds))
    options = "" if study.options is None else f" --options {study.options}"
    command = f"python -m experiments.pioneer.twin --runs {study.runs} --first-seed {study.first_seed}"
    results = {
        "command": f"{command} --trials {study.trials} --rounds {study.rounds}{options}",
        "n_runs": study.runs,
        "trials_per_run": study.trials,
        **numbers,
    }
    write(study.out, results, {"twin": draw(runs[0])})
    rows = Table("", "PyBullet", "MuJoCo", "MuJoCo − PyBullet")
    for line in table(numbers).splitlines()[2:]:
        rows.add_row(*(cell.strip() for cell in line.strip("|").split("|")))
    show(rows, f"Results and picture: {study.out}")


def numbers_of(runs: list[Result], speeds: dict[str, list[float]]) -> dict[str, Any]:
    """Success, steps and speed in both simulators, and their differences over paired trials, with intervals."""
    numbers: dict[str, Any] = {}
    for kind in ("option", "task"):
        if kind == "task" and "task" not in runs[0]["PyBullet"]:
            continue
        success, steps = (
            {name: np.array([_column(run[name], kind, column) for run in runs], dtype=float) for name in SIMULATORS}
            for column in ("success", "steps")
        )
        difference = (success["MuJoCo"] - success["PyBullet"]).ravel()
        numbers[kind] = {
            "success": {n: share_interval(int(s.sum()), s.size)._asdict() for n, s in success.items()},
            "success_of_runs": {n: s.mean(axis=1).tolist() for n, s in success.items()},
            "success_difference": {
                **mean_interval(difference)._asdict(),
                "bar": MARGIN,
                "reached": bool(abs(difference.mean()) <= MARGIN),
            },
            "steps": {n: mean_interval(s.ravel())._asdict() for n, s in steps.items()},
            "steps_difference": mean_interval((steps["MuJoCo"] - steps["PyBullet"]).ravel())._asdict(),
        }
    rates = {name: np.array(values) for name, values in speeds.items()}
    numbers["speed"] = {
        "steps_per_second": {name: mean_interval(values)._asdict() for name, values in rates.items()},
        "ratio": ratio_interval(rates["MuJoCo"], rates["PyBullet"])._asdict(),
    }
    return numbers


def table(numbers: dict[str, Any]) -> str:
    """All of it as a Markdown table."""
    rows = ["| | PyBullet | MuJoCo | MuJoCo − PyBullet |", "|---|---|---|---|"]
    words = {"option": "the option alone: {}", "task": "the whole task: {}"}
    for kind in (kind for kind in words if kind in numbers):
        found = numbers[kind]
        for what, name, form in (("success", "success", "{:.3f}"), ("primitive steps", "steps", "{:.2f}")):
            cells = [number(found[name][simulator], form=form) for simulator in SIMULATORS]
            cells.append(number(found[f"{name}_difference"], form=form))
            rows.append(f"| {words[kind].format(what)} | {' | '.join(cells)} |")
    rates = [number(numbers["speed"]["steps_per_second"][name], form="{:.0f}") for name in SIMULATORS]
    rows.append(f"| primitive steps per second | {' | '.join(rates)} | {number(numbers['speed']['ratio'])} times |")
    return "\n".join(rows)


def draw(run: Result) -> Figure:
    """Ways of both robots from the same starts, as the same option leads them."""
    half = 2.0
    by_steps = np.argsort(run["PyBullet"]["steps"], kind="stable")
    ranks = np.linspace(len(by_steps) / 2, len(by_steps) - 1, N_WAYS).astype(int)
    figure = Figure(figsize=(11, 7.6), layout="constrained")
    for axes, i in zip(figure.subplots(2, N_WAYS // 2).flat, by_steps[ranks].tolist(), strict=True):
        for name, marker in (("PyBullet", "o"), ("MuJoCo", "x")):
            x, y = np.array(run[name]["ways"][i]).T
            reached = "reached" if run[name]["reached"][i] else "not reached"
            label = f"{name}: {run[name]['steps'][i]} steps, {reached}"
            axes.plot(x, y, marker=marker, color=COLOURS[name], alpha=0.8, label=label)
        axes.plot(*run["starts"][i]["ball"], "o", markersize=13, color="#f0be20", markeredgecolor="#966e08", zorder=0)
        axes.set_xlim(-half, half)
        axes.set_ylim(-half, half)
        axes.set_aspect("equal")
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.18), frameon=False)
    figure.supxlabel("m (yellow: where the ball was)", fontsize=9)
    return figure


def _column(result: Result, kind: str, column: str) -> list[Any]:
    if kind == "task":
        values: list[Any] = result["task"]["successes" if column == "success" else "steps"]
    else:
        values = result["reached" if column == "success" else "steps"]
    return values


def _same(env: OptionsWrapper) -> OptionsWrapper:
    return env


def _place(env: gym.Env[Any, Any]) -> tuple[float, float]:
    core = env.unwrapped
    assert isinstance(core, PioneerTask)
    return core.robot_pose[:2]


if __name__ == "__main__":
    main(tyro.cli(Study))
