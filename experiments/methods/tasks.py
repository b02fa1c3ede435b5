"""What is learned: each task from nothing, and again with its goal moved."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import gymnasium as gym
import networkx as nx
import numpy as np
from gymnasium.wrappers import TimeLimit

from experiments.common.gridworlds import Cell, rooms_of, world_of
from experiments.deep.tasks import MOVED, SLACK, optimal_steps
from experiments.pioneer.agents import ball_in_sight
from experiments.published.graphs import taxi_env
from experiments.random_walks.conditions import is_bottleneck
from experiments.random_walks.maps import random_map
from sb3_options.discovery.static_filter import StaticFilter
from sb3_options.envs import KEY_FEATURE_SCALE, GridWorld

TAXI = "experiments/Taxi-v0"
TAXI_STEPS = 200
"""Of an episode, as in Gymnasium."""
TAXI_STOPS = ((0, 0), (0, 4), (4, 0), (4, 3))
"""Row and column of each stop, by number."""
ABOARD = len(TAXI_STOPS)
"""Where the passenger is who is at no stop."""

MAPS = ((1, 2), (1, 3), (2, 2), (1, 5), (2, 3))
"""Rows and columns of the random maps' rooms: two to six rooms, each number equally likely."""
SIDES = (3, 6)
"""Least and largest side of their rooms, in cells, so that random walks reach the last of six."""

PIONEER_STEPS = 100
"""Within which the robot has to be done: four times what a trained one takes (docs/studies/pioneer.md)."""
PIONEER_UNIT = math.radians(5)
"""One unit of the robot's concept space, as in `experiments.pioneer`."""
NEAR_BALL = (0.0, math.radians(45))
"""Displacement and width of a ball dead ahead and near: the subgoal of the paper's figure 8."""


@dataclass(frozen=True)
class RaceTask:
    """A task, and the same with its goal moved.

    Attributes:
        env: Gymnasium id.
        same: Keyword arguments of the environment that is learned from nothing.
        moved: Of the one that is learned with the options of the first.
        discovery: Settings that belong to its concept space, the same for all methods.
        option: Likewise, of how options are learned.
        static_filter: What may be a subgoal; None for the default.
        evaluate_every: Primitive steps between evaluations.
        evaluation_episodes: Of each.
    """

    env: str
    same: Mapping[str, Any] = field(default_factory=dict)
    moved: Mapping[str, Any] = field(default_factory=dict)
    discovery: Mapping[str, Any] = field(default_factory=dict)
    option: Mapping[str, Any] = field(default_factory=dict)
    static_filter: StaticFilter | None = None
    evaluate_every: int = 1_000
    evaluation_episodes: int = 20


_GRIDS = ("TwoRooms", "FourRooms", "KeyDoor")

AWAY = 2
"""Steps that the goal moves at least, without walls."""

TASKS = (*_GRIDS, "random maps", "Taxi", "Pioneer")


def task_for(name: str, seed: int) -> RaceTask:
    """A task of `TASKS`; where the goal moves to in gridworlds depends on the seed, and so do random maps."""
    if name in _GRIDS:
        env = f"sb3_options/{name}-v0"
        return RaceTask(env, {}, {"goal": moved_goal(world_of(env), seed), **MOVED})
    if name == "random maps":
        drawn = random_map(seed, shapes=MAPS, sides=SIDES)
        moved = {"map": drawn, "goal": moved_goal(GridWorld(drawn), seed), **MOVED}
        return RaceTask("sb3_options/TwoRooms-v0", {"map": drawn}, moved)
    if name == "Taxi":
        return RaceTask(TAXI, {"destination": 0}, {"destination": 1})
    discovery = {"search": "exhaustive", "scale": 1 / PIONEER_UNIT, "start_radius": 1.0, "goal_radius": 0.0}
    option = {"policy_input": "features", "value_function": "network", "initiation_steps": 20}
    return RaceTask(
        "sb3_options/Pioneer-v0",
        {},
        {"deposit": "corner"},
        discovery={**discovery, "subgoal_radius": 1.0},
        option={**option, "initiation_radius": 3.0, "max_duration": 20, "leave_reward": -10.0, "gamma": 0.95},
        static_filter=ball_in_sight,
        evaluate_every=2_000,  # its steps take longer
        evaluation_episodes=10,
    )


def moved_goal(world: GridWorld, seed: int) -> Cell:
    """A cell of the goal's room that is `AWAY` from it, each as likely as any other.

    A corner would favour options that lead to corners: there the subgoal would be the goal.
    """
    room = next(room for room in rooms_of(world) if world.goal in room)
    x, y = world.goal
    cells = sorted(cell for cell in room if abs(cell[0] - x) + abs(cell[1] - y) >= AWAY)
    return cells[int(np.random.default_rng(seed).integers(len(cells)))]


def step_limit(task: RaceTask, kwargs: Mapping[str, Any]) -> int:
    """Primitive steps within which an episode is a success: `SLACK` times those of the best policy."""
    if task.env == TAXI:
        return round(SLACK * best_taxi_steps(kwargs["destination"]))
    if "Pioneer" in task.env:
        return PIONEER_STEPS
    return round(SLACK * optimal_steps(world_of(task.env, **kwargs)))


def places(task: RaceTask) -> list[Sequence[float]]:
    """The bottlenecks as somebody who knows the task would place them, in concept space."""
    if task.env == TAXI:
        env, destination = taxi_env(), task.same["destination"]
        stops = [stop for i, stop in enumerate(TAXI_STOPS) if i != destination]
        aboard = [env.encode(row, column, ABOARD, destination) // len(TAXI_STOPS) for row, column in stops]
        return np.eye(len(env.P) // len(TAXI_STOPS))[aboard].tolist()  # type: ignore[no-any-return]  # a list of lists
    if "Pioneer" in task.env:
        return [NEAR_BALL]
    world = world_of(task.env, **task.same)
    if world.keys:
        return [(x, y, KEY_FEATURE_SCALE) for x, y in [*world.keys, *world.doors]]
    return [(float(x), float(y)) for x, y in world.doorways]


def at_bottleneck(task: RaceTask, point: Sequence[float]) -> bool | None:
    """Whether a subgoal is one; None where nobody can say.

    In gridworlds it is if it lies within a cell of a doorway, a door or a key; in Taxi, if the passenger gets in there:
    at the passenger's stop, before or after. The destination is none.
    """
    if "Pioneer" in task.env:
        return None
    if task.env == TAXI:
        row, column, passenger, _ = taxi_env().decode(int(np.argmax(point)) * len(TAXI_STOPS))
        stops = [stop for i, stop in enumerate(TAXI_STOPS) if i != task.same["destination"]]
        return (row, column) in (stops if passenger == ABOARD else TAXI_STOPS[passenger : passenger + 1])
    return is_bottleneck(world_of(task.env, **task.same), point)


class OneDestination(gym.Wrapper[Any, Any, Any, Any]):
    """Taxi's states without the destination, and in ``info["is_success"]`` whether the passenger was delivered.

    With the destination in it no state of one task would be one of the other.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        n_states = cast("gym.spaces.Discrete", env.observation_space).n
        self.observation_space = gym.spaces.Discrete(int(n_states) // len(TAXI_STOPS))

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Row, column and passenger as one number."""
        observation, info = super().reset(**kwargs)
        return observation // len(TAXI_STOPS), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step; an episode terminates by delivery alone."""
        observation, reward, terminated, truncated, info = super().step(action)
        told = {**info, "is_success": bool(terminated)}
        return observation // len(TAXI_STOPS), reward, terminated, truncated, told


def taxi_to(destination: int, max_steps: int = TAXI_STEPS) -> gym.Env[Any, Any]:
    """Taxi whose passengers all want to the same stop, so that there is a goal to move."""
    env = taxi_env()
    wants = np.array([list(env.decode(state))[-1] == destination for state in range(len(env.P))])
    env.initial_state_distrib = env.initial_state_distrib * wants
    env.initial_state_distrib /= env.initial_state_distrib.sum()
    return TimeLimit(OneDestination(env), max_steps)


def best_taxi_steps(destination: int) -> float:
    """Expected steps of the best policy."""
    env: Any = taxi_to(destination).unwrapped
    steps = steps_to_deliver(env)
    return float(sum(share * steps[state] for state, share in enumerate(env.initial_state_distrib) if share))


def steps_to_deliver(env: Any) -> dict[Any, int]:
    """Steps of the best policy from each state of Taxi that an episode may pass."""
    back = nx.DiGraph()
    for state, actions in env.P.items():
        back.add_edges_from(("home" if ended else led, state) for ((_, led, _, ended),) in actions.values())
    return dict(nx.single_source_shortest_path_length(back, "home"))


if TAXI not in gym.registry:
    gym.register(TAXI, entry_point="experiments.methods.tasks:taxi_to")
