"""What is run for every seed: five groups of agents, each a function of settings and seed with a JSON result.

All agents of a seed's main task share their first trials: up to the one in which discovery makes its option they are
the same agent, bit for bit, and are forked there. What differs afterwards is the option, and nothing else.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from experiments.common.agents import live, wrapper_of
from experiments.common.gridworlds import Cell, cell_of, distance_to_doorway
from experiments.common.seeds import Result
from experiments.paper import measures
from experiments.paper.agents import (
    Replay,
    SingleEnv,
    discoverer,
    fork,
    make_agent,
    steps_in_initiation_set,
    world_of,
)
from experiments.paper.settings import TRANSFER_GOAL, PaperSettings
from sb3_options import MacroQ
from sb3_options.atomic import atomic_write
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.regions import Region
from sb3_options.envs import GridWorld
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.success import success_by_steps
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.options.creation import learn_option
from sb3_options.options.option import Option, SubgoalOption

STRICT, SOFT = 1.0, 0.1
"""Strength η of negative bags: a noisy-or that allows no exception, and the library's default."""

REPLAYS: dict[str, tuple[bool, int | None]] = {
    "replay_whole": (True, None),
    "replay_partial": (False, None),
    "replay_whole_once": (True, 1),
    "replay_partial_once": (False, 1),
}
"""Whether over the whole state space, and how many sweeps at first: as many as the option's, or one.

The option agent of the paper made fewer backups a trajectory than the trajectory has steps: one sweep.
"""

BASELINE_SEED, REPLAY_SEED, RANDOM_SUBGOAL_SEED = 1, 2, 3
"""Mixed into a run's seed, so that these draws are apart from the agent's."""


class Start(NamedTuple):
    """An agent at the end of the trial in which its option was made, or of the last trial if none was.

    Attributes:
        agent: Who goes on discovering.
        callback: What discovers.
        lengths: Primitive steps of each trial so far.
        saved: The trajectories so far.
    """

    agent: MacroQ
    callback: SubgoalDiscoveryCallback
    lengths: list[int]
    saved: list[LabelledTrajectory]

    @property
    def option(self) -> SubgoalOption | None:
        """The discovered option."""
        option = self.callback.bank[0]
        return option if isinstance(option, SubgoalOption) else None


def until_option(settings: PaperSettings, seed: int) -> Start:
    """Live until the option is made."""
    agent = make_agent(settings, seed)
    callback = discoverer(settings, seed)
    trials = live(agent, settings.trials, callback, until=lambda: bool(callback.discoveries))
    assert callback.discovery is not None  # made when training started
    return Start(agent, callback, trials.lengths, list(callback.discovery.database))


def learning(settings: PaperSettings, artifacts: Path, seed: int) -> Result:
    """Figures 1 to 3: with discovery and without.

    Args:
        settings: Of the study.
        artifacts: Folder for the option and the value function, which the transfer task starts from.
        seed: Of the run.
    """
    start = until_option(settings, seed)
    primitive, lengths, world = fork(start.agent), list(start.lengths), world_of(start.agent)
    wanted = min(settings.trials, max(settings.negative_trials, settings.density_trials, settings.histogram_trials[1]))
    saved = start.saved + _record(primitive, wanted - len(lengths), lengths)
    lengths += live(primitive, settings.trials - len(lengths)).lengths
    with_option = live(start.agent, settings.trials - len(start.lengths), start.callback).lengths
    _save(start, artifacts, seed)

    found = start.callback.discoveries
    in_trials = saved[slice(*settings.histogram_trials)]
    early = measures.discovery_of(settings, saved[: settings.density_trials])
    return {
        "primitive": lengths,
        "discovery": start.lengths + with_option,
        "option": _subgoal(world, (found[0].episode, cell_of(found[0].subgoal)) if found else None)
        | {"initiation_states": found[0].initiation_states if found else None},
        "visits": {
            "every": measures.visit_counts(world, in_trials, first_only=False).tolist(),
            "first": measures.visit_counts(world, in_trials, first_only=True).tolist(),
        },
        "log_density": _plain(measures.density_map(world, early)),
        "baselines": _baselines(settings, world, saved[: len(start.lengths)], seed),
        "noisy": {
            name: _subgoal(
                world,
                measures.first_subgoal(
                    settings,
                    saved[: settings.negative_trials],
                    success=success_by_steps(settings.negative_step_limit),
                    negative_strength=strength,
                ),
            )
            for name, strength in (("strict", STRICT), ("soft", SOFT))
        },
    }


def _record(agent: MacroQ, n_trials: int, lengths: list[int]) -> list[LabelledTrajectory]:
    """Live for some trials, append their lengths, and return their trajectories."""
    wrapper = wrapper_of(agent)
    wrapper.set_slots(record=True)
    trials = live(agent, n_trials)
    wrapper.set_slots(record=False)
    lengths += trials.lengths
    return [_labelled(agent, info["trajectory"]) for info in trials.infos]


def _labelled(agent: MacroQ, trajectory: Trajectory) -> LabelledTrajectory:
    features = wrapper_of(agent).concept_features(trajectory.states)
    return LabelledTrajectory(trajectory, features, bool(trajectory.is_success))


def _subgoal(world: GridWorld, found: tuple[int, Cell] | None) -> dict[str, Any]:
    if found is None:
        return {"trial": None, "subgoal": None, "distance": None}
    trial, cell = found
    return {"trial": trial, "subgoal": list(cell), "distance": distance_to_doorway(world, cell)}


def _plain(values: FloatArray | None) -> list[list[float | None]] | None:
    """For JSON, with None for NaN."""
    if values is None:
        return None
    return [[None if np.isnan(v) else round(float(v), 6) for v in row] for row in values]


def _baselines(settings: PaperSettings, world: GridWorld, saved: list[LabelledTrajectory], seed: int) -> Result:
    discovery = measures.discovery_of(settings, saved)
    found: Result = {}
    for name, first_only in (("first", True), ("every", False)):
        rng = np.random.default_rng([seed, BASELINE_SEED])
        cell = measures.most_visited(world, discovery, first_only=first_only, rng=rng)
        found[name] = _subgoal(world, None if cell is None else (len(saved), cell))
    return found


def _files(artifacts: Path, seed: int) -> tuple[Path, Path]:
    return artifacts / f"{seed}.safetensors", artifacts / f"{seed}.npz"


def _save(start: Start, artifacts: Path, seed: int) -> None:
    options, values = _files(artifacts, seed)
    artifacts.mkdir(parents=True, exist_ok=True)
    start.callback.bank.save(options)
    option, cells = start.option, np.arange(world_of(start.agent).walls.size)
    width = world_of(start.agent).width
    features = np.stack([cells % width, cells // width], axis=1).astype(np.float64)
    inside = np.zeros(len(cells), dtype=bool) if option is None else steps_in_initiation_set(option, features)
    with atomic_write(values) as temporary, temporary.open("wb") as file:
        np.savez(file, values=start.agent.policy.table(), inside=inside)


def controls(settings: PaperSettings, seed: int) -> Result:
    """Figure 4 and the controls: replay without an option, a hand-made option, and a random subgoal."""
    start = until_option(settings, seed)
    option, rest = start.option, settings.control_trials - len(start.lengths)
    result: Result = {"replayed": {}}
    for name, (whole, sweeps) in REPLAYS.items():
        agent, replay = fork(start.agent), None
        if option is not None:
            rng = np.random.default_rng([seed, REPLAY_SEED])
            sweeps = sweeps or settings.replay_sweeps
            replay = Replay(option, start.saved, settings, whole=whole, sweeps=sweeps, rng=rng)
        result[name] = start.lengths + live(agent, rest, replay).lengths
        result["replayed"][name] = 0 if replay is None else replay.backups
    world = world_of(start.agent)
    random = random_option(settings, start, np.random.default_rng([seed, RANDOM_SUBGOAL_SEED]))
    result["random_subgoal"] = list(cell_of(random.subgoal.points[0]))
    for name, other in (("handmade", doorway_option(world)), ("random", random)):
        agent = fork(start.agent)
        if option is not None:
            wrapper_of(agent).set_option(0, other)
        if name == "random":
            cast("SingleEnv", agent.get_env()).step_limit = settings.random_step_limit
        result[name] = start.lengths + live(agent, rest, discoverer(settings, seed, max_new_options=0)).lengths
    return result


def doorway_option(world: GridWorld) -> Option:
    """Hand-made: from anywhere in the left room along a shortest path to the doorway."""
    door_x, door_y = world.doorways[0]
    left, right, up, down = (2, 3, 0, 1)

    def x_and_y(observations: Any) -> tuple[Any, Any]:
        y, x = np.divmod(np.asarray(observations).argmax(axis=1), world.width)
        return x, y

    def initiation(observations: Any) -> Any:
        return x_and_y(observations)[0] < door_x

    def policy(observations: Any) -> Any:
        x, y = x_and_y(observations)
        return np.where(y < door_y, down, np.where(y > door_y, up, np.where(x < door_x, right, left)))

    def termination(observations: Any) -> Any:
        x, y = x_and_y(observations)
        return (x == door_x) & (y == door_y)

    return Option(initiation, policy, termination, name="doorway")


def random_option(settings: PaperSettings, start: Start, rng: np.random.Generator) -> SubgoalOption:
    """Made like a discovered option, for a uniformly random one of the states seen so far, the goal excepted."""
    seen = np.unique(np.concatenate([labelled.features for labelled in start.saved]), axis=0)
    seen = seen[(seen != world_of(start.agent).goal).any(axis=1)]
    n_primitive = wrapper_of(start.agent).n_primitive
    while True:
        subgoal = Region(seen[int(rng.integers(len(seen)))][None], np.ones(2), settings.discovery().subgoal_radius)
        option = learn_option(subgoal, start.saved, n_primitive, settings.option(), torch.Generator(), name="random")
        if option is not None:  # none if every trajectory that visits the subgoal began there
            return option


def transfer(settings: PaperSettings, artifacts: Path, seed: int) -> Result:
    """Figure 5: the new task with primitives only, and with the option of the same run."""
    plain, helped = _new_task(settings, seed, slots=False), _new_task(settings, seed, slots=True)
    wrapper_of(helped).bank.load(_files(artifacts, seed)[0])
    return {
        "primitive": live(plain, settings.transfer_trials).lengths,
        "options": live(helped, settings.transfer_trials, discoverer(settings, seed, max_new_options=0)).lengths,
    }


def _new_task(settings: PaperSettings, seed: int, *, slots: bool) -> MacroQ:
    success = settings.transfer_success_probability
    return make_agent(settings, seed, slots=slots, goal=TRANSFER_GOAL, success_probability=success)


def reuse(settings: PaperSettings, artifacts: Path, seed: int) -> Result:
    """Figure 6: the new task from the old primitive value function, whole or on the option's input set."""
    with np.load(_files(artifacts, seed)[1]) as file:
        values, inside = file["values"], file["inside"]
    result: Result = {}
    for name, rows in (("whole", np.ones(len(inside), dtype=bool)), ("partial", inside)):
        agent = _new_task(settings, seed, slots=False)
        table = agent.policy.table()
        table[rows] = values[rows, : table.shape[1]]
        result[name] = live(agent, settings.reuse_trials).lengths
    return result


def negatives(settings: PaperSettings, seed: int) -> Result:
    """Figure 2 with a step limit: what does not arrive within it makes a negative bag."""
    agent = make_agent(settings, seed, max_steps=settings.negative_step_limit)
    saved, world = _record(agent, settings.negative_trials, []), world_of(agent)
    result: Result = {"n_negative": sum(not labelled.success for labelled in saved[: settings.density_trials])}
    for name, strength in (("strict", STRICT), ("soft", SOFT)):
        early = measures.discovery_of(settings, saved[: settings.density_trials], negative_strength=strength)
        found = measures.first_subgoal(settings, saved, negative_strength=strength)
        result[name] = _subgoal(world, found) | {"log_density": _plain(measures.density_map(world, early))}
    found = measures.first_subgoal(settings, saved, negative_strength=SOFT, loops=False)
    return result | {"without_loops": _subgoal(world, found)}
