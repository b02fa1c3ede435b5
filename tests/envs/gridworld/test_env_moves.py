"""Where an agent goes and what it is rewarded with: walls, chance, starts, key and door, the end."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from sb3_options.envs import Direction, GridWorld
from sb3_options.envs.gridworld.grid_map import Cell
from tests.envs.gridworld.cells import cell_of


def walk(env: GridWorld, start: Cell, actions: list[Direction]) -> list[Cell]:
    observation, _ = env.reset(options={"start": start})
    cells = [cell_of(env, observation)]
    for action in actions:
        observation, *_ = env.step(action)
        cells.append(cell_of(env, observation))
    return cells


@pytest.mark.parametrize(
    ("start", "actions", "cells"),
    [
        ((0, 0), [Direction.UP, Direction.LEFT], [(0, 0), (0, 0), (0, 0)]),
        ((3, 3), list(Direction), [(3, 3), (3, 2), (3, 3), (2, 3), (3, 3)]),
        ((9, 4), [Direction.RIGHT, Direction.DOWN], [(9, 4), (9, 4), (9, 5)]),
        ((9, 5), [Direction.RIGHT] * 2, [(9, 5), (10, 5), (11, 5)]),
        ((10, 5), [Direction.UP, Direction.DOWN], [(10, 5), (10, 5), (10, 5)]),
        ((20, 8), [Direction.RIGHT, Direction.DOWN], [(20, 8), (20, 8), (20, 9)]),
    ],
)
def test_two_rooms(start: Cell, actions: list[Direction], cells: list[Cell]) -> None:
    assert walk(GridWorld(success_probability=1), start, actions) == cells


def test_rewards_and_the_end() -> None:
    env = GridWorld("S.G", success_probability=1, goal_reward=2, step_reward=-0.5)
    env.reset()
    assert env.step(Direction.RIGHT)[1:] == (-0.5, False, False, {"is_success": False})
    assert env.step(Direction.RIGHT)[1:] == (2.0, True, False, {"is_success": True})


def test_truncates_by_itself() -> None:
    env = GridWorld("S.G", success_probability=1, max_steps=3)
    for _ in range(2):
        env.reset()
        assert [env.step(Direction.LEFT)[2:4] for _ in range(3)] == [(False, False), (False, False), (False, True)]


def test_goal_on_the_last_step_is_success_not_truncation() -> None:
    env = GridWorld("SG", success_probability=1, max_steps=1)
    env.reset()
    assert env.step(Direction.RIGHT)[2:] == (True, False, {"is_success": True})


def test_a_continuing_task_goes_on_from_a_start() -> None:
    env = GridWorld("S.G", success_probability=1, continuing=True, step_reward=-0.5, max_steps=6, observation="xy")
    for _ in range(2):
        env.reset()
        steps = [env.step(Direction.RIGHT) for _ in range(6)]
        assert [int(observation[0]) for observation, *_ in steps] == [1, 2, 0, 1, 2, 0]
        assert [reward for _, reward, *_ in steps] == [-0.5, 1.0, -0.5, -0.5, 1.0, -0.5]
        assert not any(terminated for _, _, terminated, *_ in steps)
        assert [truncated for *_, truncated, _ in steps] == [False] * 5 + [True]
        assert [info["is_success"] for *_, info in steps] == [False] + [True] * 5


@pytest.mark.parametrize("success_probability", [0.0, 0.3, 0.9, 1.0])
def test_success_probability(success_probability: float) -> None:
    """Each direction's count lies within its exact binomial range, false alarms below 1e-6 each."""
    n = 20_000
    env = GridWorld("...\n.S.\n..G", success_probability=success_probability, max_steps=None)
    env.reset(seed=0)
    counts = dict.fromkeys([(1, 0), (1, 2), (0, 1), (2, 1)], 0)
    for _ in range(n):
        env.reset()
        counts[cell_of(env, env.step(Direction.UP)[0])] += 1
    slip = (1 - success_probability) / 4
    for cell, count in counts.items():
        p = success_probability + slip if cell == (1, 0) else slip
        low, high = np.asarray(binom.ppf([5e-7, 1 - 5e-7], n, p))
        assert low <= count <= high, cell


def test_starts_are_drawn_uniformly() -> None:
    n = 20_000
    env = GridWorld("SSSSG", observation="xy")
    env.reset(seed=0)
    columns = [int(env.reset()[0][0]) for _ in range(n)]
    low, high = np.asarray(binom.ppf([5e-7, 1 - 5e-7], n, 1 / 4))
    assert all(low <= columns.count(x) <= high for x in range(4))
    assert columns.count(4) == 0


@settings(max_examples=60)
@given(data=st.data())
def test_never_stands_on_a_wall(data: st.DataObject) -> None:
    width, height = data.draw(st.integers(2, 6)), data.draw(st.integers(1, 6))
    cells = data.draw(st.lists(st.sampled_from("..#"), min_size=width * height, max_size=width * height))
    start, goal = data.draw(st.permutations(range(width * height)))[:2]
    cells[start], cells[goal] = "S", "G"
    rows = ["".join(cells[y * width : (y + 1) * width]) for y in range(height)]
    try:
        env = GridWorld("\n".join(rows), success_probability=0.5)
    except ValueError as error:
        assert "cannot reach the goal" in str(error)  # noqa: PT017 - only some of the maps raise
        return
    env.reset(seed=data.draw(st.integers(0, 2**32 - 1)))
    x, y = env.start_cells[0]
    for action in data.draw(st.lists(st.integers(0, 3), max_size=40)):
        observation, _, terminated, _, _ = env.step(action)
        before = (x, y)
        x, y = cell_of(env, observation)
        assert not env.walls[y, x]
        assert abs(x - before[0]) + abs(y - before[1]) <= 1
        assert terminated == ((x, y) == env.goal)
        if terminated:
            break


def test_door_opens_with_the_key_only() -> None:
    env = GridWorld("K.SDG", success_probability=1)
    assert walk(env, (2, 0), [Direction.RIGHT] * 2) == [(2, 0)] * 3
    cells = walk(env, (2, 0), [Direction.LEFT] * 2 + [Direction.RIGHT] * 4)
    assert cells == [(2, 0), (1, 0), (0, 0), (1, 0), (2, 0), (3, 0), (4, 0)]
