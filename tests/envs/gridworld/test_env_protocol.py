"""A grid world keeps Gymnasium's protocol: ids, arguments, errors, pictures."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_options.envs import FOUR_ROOMS, KEY_DOOR, TWO_ROOMS, Direction, GridWorld
from sb3_options.envs.gridworld.drawing import AGENT, GOAL, RENDER_CELL_PX
from sb3_options.envs.gridworld.grid_map import Cell
from sb3_options.envs.gridworld.maps import FOUR_ROOMS_MAX_STEPS, KEY_DOOR_MAX_STEPS, TWO_ROOMS_MAX_STEPS
from tests.envs.gridworld.cells import KINDS, Kind

pytestmark = pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")

IDS = ["sb3_options/TwoRooms-v0", "sb3_options/FourRooms-v0", "sb3_options/KeyDoor-v0"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("env_id", IDS)
def test_check_env(env_id: str, kind: Kind) -> None:
    check_env(gymnasium.make(env_id, observation=kind, render_mode="rgb_array").unwrapped)
    sb3_check_env(gymnasium.make(env_id, observation=kind))


@pytest.mark.parametrize(
    ("env_id", "goal", "max_steps"),
    [
        (IDS[0], (20, 9), TWO_ROOMS_MAX_STEPS),
        (IDS[1], (11, 11), FOUR_ROOMS_MAX_STEPS),
        (IDS[2], (12, 7), KEY_DOOR_MAX_STEPS),
    ],
)
def test_ids_make_their_maps(env_id: str, goal: Cell, max_steps: int) -> None:
    spec = gymnasium.spec(env_id)
    env = spec.make().unwrapped
    assert isinstance(env, GridWorld)
    assert env.goal == goal
    assert spec.kwargs["max_steps"] == max_steps
    assert spec.max_episode_steps is None


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"success_probability": 1.1}, ValueError, r"success_probability must be in 0\.\.1, got 1\.1"),
        ({"success_probability": "0.9"}, TypeError, r"success_probability must be a number, got '0\.9'"),
        ({"goal_reward": float("inf")}, ValueError, r"goal_reward must be finite, got inf"),
        ({"max_steps": 0}, ValueError, r"max_steps must be at least 1, got 0"),
        ({"observation": "rgb"}, ValueError, r"observation must be one of 'onehot', 'xy', 'image', got 'rgb'"),
        ({"render_mode": "depth"}, ValueError, r"render_mode must be one of 'human', 'rgb_array', got 'depth'"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        GridWorld(**kwargs)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"strat": (0, 0)}, ValueError, r"options has the unknown key 'strat': only 'start' is understood"),
        ({"start": None}, TypeError, r"options\['start'\] must be a cell \(x, y\) of two integers, got None"),
    ],
)
def test_bad_reset_options(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        GridWorld().reset(options=options)


@pytest.mark.parametrize("action", [-1, 4, 1.0])
def test_bad_actions(action: Any) -> None:
    env = GridWorld()
    env.reset()
    with pytest.raises(gymnasium.error.InvalidAction, match=r"action must be an integer in 0\.\.3, got "):
        env.step(action)


@pytest.mark.parametrize("action", [Direction.RIGHT, Direction.LEFT])
def test_step_after_the_end(action: Direction) -> None:
    env = GridWorld("SG", success_probability=1, max_steps=1)
    env.reset()
    env.step(action)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"after the episode's end: call reset\(\) first"):
        env.step(action)


@pytest.mark.parametrize("map", [TWO_ROOMS, FOUR_ROOMS, KEY_DOOR])
def test_rgb_array(map: str) -> None:
    env = GridWorld(map, render_mode="rgb_array")
    start = env.start_cells[0]
    env.reset(options={"start": start})
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    assert picture.shape == (RENDER_CELL_PX * env.height, RENDER_CELL_PX * env.width, 3)
    assert picture.dtype == np.uint8

    def centre(cell: Cell) -> tuple[int, ...]:
        x, y = (RENDER_CELL_PX * c + RENDER_CELL_PX // 2 for c in cell)
        return tuple(int(channel) for channel in picture[y, x])

    wall_y, wall_x = np.argwhere(env.walls)[0]
    colours = [centre(start), centre(env.goal), centre((int(wall_x), int(wall_y))), centre(env.start_cells[1])]
    assert colours[:2] == [AGENT, GOAL]
    assert len(set(colours)) == 4
