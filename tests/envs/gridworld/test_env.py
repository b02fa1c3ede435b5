import copy
import importlib
import pickle
from collections.abc import Iterator
from typing import Any, Literal

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import binom
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import sb3_options.envs
from sb3_options.envs import FOUR_ROOMS, KEY_DOOR, KEY_FEATURE_SCALE, TWO_ROOMS, Direction, GridWorld
from sb3_options.envs.gridworld.drawing import AGENT, GOAL, RENDER_CELL_PX
from sb3_options.envs.gridworld.grid_map import Cell
from sb3_options.envs.gridworld.maps import FOUR_ROOMS_MAX_STEPS, KEY_DOOR_MAX_STEPS, TWO_ROOMS_MAX_STEPS

IDS = ["sb3_options/TwoRooms-v0", "sb3_options/FourRooms-v0", "sb3_options/KeyDoor-v0"]
KINDS: tuple[Literal["onehot"], Literal["xy"], Literal["image"]] = ("onehot", "xy", "image")
Kind = Literal["onehot", "xy", "image"]

# "human" is checked on matplotlib's backend without windows, which warns where there is a display.
pytestmark = pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")


@pytest.fixture(autouse=True)
def no_display() -> Iterator[None]:
    plt.switch_backend("agg")
    yield
    plt.close("all")


def cell_of(env: GridWorld, observation: NDArray[Any]) -> Cell:
    x, y = env.concept_features(observation[None])[0, :2]
    return int(x), int(y)


def walk(env: GridWorld, start: Cell, actions: list[Direction]) -> list[Cell]:
    observation, _ = env.reset(options={"start": start})
    cells = [cell_of(env, observation)]
    for action in actions:
        observation, *_ = env.step(action)
        cells.append(cell_of(env, observation))
    return cells


def trajectory(env: GridWorld, seed: int, n_steps: int = 300) -> list[tuple[bytes, float, bool, bool]]:
    actions = np.random.default_rng(seed).integers(4, size=n_steps)
    observation, _ = env.reset(seed=seed)
    record = [(observation.tobytes(), 0.0, False, False)]
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        record.append((observation.tobytes(), reward, terminated, truncated))
        if terminated or truncated:
            observation, _ = env.reset()
            record.append((observation.tobytes(), 0.0, False, False))
    return record


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_check_env(env_id: str, kind: Kind) -> None:
    check_env(gymnasium.make(env_id, observation=kind, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("env_id", IDS)
def test_sb3_check_env(env_id: str, kind: Kind) -> None:
    sb3_check_env(gymnasium.make(env_id, observation=kind))


def test_observation_spaces() -> None:
    def shape(map: str, kind: Kind) -> tuple[tuple[int, ...] | None, str]:
        space = GridWorld(map, observation=kind).observation_space
        return space.shape, str(space.dtype)

    assert shape(TWO_ROOMS, "onehot") == ((210,), "float32")
    assert shape(KEY_DOOR, "onehot") == ((208,), "float32")
    assert shape(TWO_ROOMS, "xy") == ((2,), "float32")
    assert shape(KEY_DOOR, "xy") == ((3,), "float32")
    assert shape(TWO_ROOMS, "image") == ((40, 84, 3), "uint8")
    assert shape(FOUR_ROOMS, "image") == ((39, 39, 3), "uint8")
    assert shape("SG", "image") == ((36, 72, 3), "uint8")


def test_xy_bounds_are_the_map() -> None:
    space = GridWorld(KEY_DOOR, observation="xy").observation_space
    assert isinstance(space, gymnasium.spaces.Box)
    assert space.low.tolist() == [0, 0, 0]
    assert space.high.tolist() == [12, 7, 1]


@pytest.mark.parametrize("kind", KINDS)
def test_observations_may_be_kept(kind: Kind) -> None:
    env = GridWorld("S.G", observation=kind, success_probability=1)
    first, _ = env.reset()
    kept = first.copy()
    first[:] = 0
    assert cell_of(env, env.reset()[0]) == (0, 0)
    np.testing.assert_array_equal(env.reset()[0], kept)


def test_pickle_and_deepcopy_go_on_alike() -> None:
    env = GridWorld()
    env.reset(seed=3)
    twins = [env, copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    paths = [[twin.step(Direction.RIGHT)[0].argmax() for _ in range(50)] for twin in twins]
    assert paths[0] == paths[1] == paths[2]


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


def test_every_keyword_argument_can_be_overridden() -> None:
    env = gymnasium.make(
        IDS[0],
        map="S..\n###",
        goal=(2, 0),
        starts=[(1, 0)],
        success_probability=1.0,
        goal_reward=5.0,
        step_reward=-1.0,
        max_steps=1,
        observation="xy",
        render_mode="ansi",
    )
    observation, _ = env.reset()
    assert observation.tolist() == [1, 0]
    assert env.render() == ".AG\n###"
    assert env.step(np.int64(Direction.UP))[1:] == (-1.0, False, True, {"is_success": False})
    env.reset()
    assert env.step(np.int64(Direction.RIGHT))[1:] == (5.0, True, False, {"is_success": True})


def test_reload_registers_nothing_twice() -> None:
    before = gymnasium.spec(IDS[0])
    importlib.reload(sb3_options.envs)
    assert gymnasium.spec(IDS[0]) is before


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
        assert [env.step(Direction.LEFT)[2:4] for _ in range(3)] == [
            (False, False),
            (False, False),
            (False, True),
        ]


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


def test_never_truncates_without_limit() -> None:
    env = GridWorld("S.G", success_probability=1, max_steps=None)
    env.reset()
    assert not any(env.step(Direction.LEFT)[3] for _ in range(2 * TWO_ROOMS_MAX_STEPS))


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


@pytest.mark.parametrize("map", [TWO_ROOMS, FOUR_ROOMS, KEY_DOOR])
def test_one_seed_one_trajectory(map: str) -> None:
    env = GridWorld(map, max_steps=100)
    first = trajectory(env, seed=5)
    assert trajectory(env, seed=6) != first
    assert trajectory(env, seed=5) == first
    assert trajectory(GridWorld(map, max_steps=100), seed=5) == first


def test_start_option() -> None:
    env = GridWorld(observation="xy")
    for cell in [(13, 2), [0, 9], np.array([10, 5])]:
        assert env.reset(options={"start": cell})[0].tolist() == list(cell)


@settings(max_examples=60, deadline=None)
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


@pytest.mark.parametrize("kind", KINDS)
def test_key_is_seen_and_is_lost_with_the_episode(kind: Kind) -> None:
    env = GridWorld("KS.DG", success_probability=1, observation=kind)
    observations = [env.reset()[0]]
    observations += [env.step(action)[0] for action in (Direction.LEFT, Direction.RIGHT)]
    observations += [env.reset()[0]]
    features = env.concept_features(np.stack(observations))
    assert features.tolist() == [
        [1, 0, 0],
        [0, 0, KEY_FEATURE_SCALE],
        [1, 0, KEY_FEATURE_SCALE],
        [1, 0, 0],
    ]


def test_start_on_the_key_picks_it_up() -> None:
    env = GridWorld("KS.DG", observation="xy")
    assert env.reset(options={"start": (0, 0)})[0].tolist() == [0, 0, 1]


def test_key_is_far_from_no_key() -> None:
    assert np.exp(-(KEY_FEATURE_SCALE**2)) < 1e-10


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("map", [TWO_ROOMS, FOUR_ROOMS])
def test_is_the_cell_for_all_cells(map: str, kind: Kind, dtype: type[np.generic]) -> None:
    env = GridWorld(map, observation=kind)
    cells = [(int(x), int(y)) for y, x in np.argwhere(~env.walls)]
    cells.remove(env.goal)
    observations = np.stack([env.reset(options={"start": cell})[0] for cell in cells]).astype(dtype)
    features = env.concept_features(observations)
    assert features.dtype == np.float64
    assert features.tolist() == [list(cell) for cell in cells]


@pytest.mark.parametrize("kind", KINDS)
def test_is_the_cell_of_the_goal(kind: Kind) -> None:
    env = GridWorld("S.\n.G", observation=kind, success_probability=1)
    env.reset()
    observation = [env.step(action)[0] for action in (Direction.RIGHT, Direction.DOWN)][-1]
    assert cell_of(env, observation) == (1, 1)


@pytest.mark.parametrize("kind", KINDS)
def test_is_the_cell_with_the_key(kind: Kind) -> None:
    """A tour with the key through every cell of a room, the door and the room behind it."""
    env = GridWorld("K..S#G\n....D.", observation=kind, success_probability=1)
    env.reset(options={"start": (0, 0)})
    right, left, down, up = Direction.RIGHT, Direction.LEFT, Direction.DOWN, Direction.UP
    tour = [right, right, right, down, left, left, left, right, right, right, right, right, up]
    observations = np.stack([env.step(action)[0] for action in tour])
    cells = [
        (1, 0),
        (2, 0),
        (3, 0),
        (3, 1),
        (2, 1),
        (1, 1),
        (0, 1),
        (1, 1),
        (2, 1),
        (3, 1),
        (4, 1),
        (5, 1),
    ]
    cells.append((5, 0))
    expected = [[x, y, KEY_FEATURE_SCALE] for x, y in cells]
    assert env.concept_features(observations).tolist() == expected


@pytest.mark.parametrize("kind", KINDS)
def test_empty_batch(kind: Kind) -> None:
    env = GridWorld(observation=kind)
    shape = env.observation_space.shape
    assert shape is not None
    assert env.concept_features(np.empty((0, *shape))).shape == (0, 2)


@pytest.mark.parametrize("kind", KINDS)
def test_leaves_the_observations_alone(kind: Kind) -> None:
    env = GridWorld("KS.DG", observation=kind)
    observations = env.reset(options={"start": (0, 0)})[0][None]
    kept = observations.copy()
    env.concept_features(observations)
    env.concept_features(observations)
    np.testing.assert_array_equal(observations, kept)


def test_unbatched_observation_is_refused() -> None:
    env = GridWorld()
    with pytest.raises(ValueError, match=r"observations of shape \(210,\) each, got shape \(210,\)"):
        env.concept_features(env.reset()[0])


def test_image_without_agent_is_refused() -> None:
    env = GridWorld("S.G", observation="image")
    images = np.stack([env.reset()[0]] * 3)
    images[1] = 0
    with pytest.raises(ValueError, match=r"observations\[1\] shows no agent: pass the environment's own"):
        env.concept_features(images)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"map": "S"}, ValueError, r"map must have exactly one goal 'G', got 0"),
        ({"goal": (10, 0)}, ValueError, r"goal \(10, 0\) is a wall"),
        ({"starts": [(10, 0)]}, ValueError, r"starts\[0\] \(10, 0\) is a wall"),
        ({"success_probability": 1.1}, ValueError, r"success_probability must be in 0\.\.1, got 1\.1"),
        ({"success_probability": -0.1}, ValueError, r"success_probability must be in 0\.\.1, got -0\.1"),
        (
            {"success_probability": float("nan")},
            ValueError,
            r"success_probability must be in 0\.\.1, got nan",
        ),
        ({"success_probability": "0.9"}, TypeError, r"success_probability must be a number, got '0\.9'"),
        ({"goal_reward": float("inf")}, ValueError, r"goal_reward must be finite, got inf"),
        ({"step_reward": None}, TypeError, r"step_reward must be a number, got None"),
        ({"max_steps": 0}, ValueError, r"max_steps must be at least 1, or None for no limit, got 0"),
        ({"continuing": "yes"}, TypeError, r"continuing must be True or False, got 'yes'"),
        ({"max_steps": 1e3}, TypeError, r"max_steps must be an integer or None, got 1000\.0"),
        (
            {"observation": "rgb"},
            ValueError,
            r"observation must be one of 'onehot', 'xy', 'image', got 'rgb'",
        ),
        (
            {"render_mode": "depth"},
            ValueError,
            r"render_mode must be one of 'human', 'rgb_array', 'ansi', got 'depth'",
        ),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        GridWorld(**kwargs)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"strat": (0, 0)},
            ValueError,
            r"options has the unknown key 'strat': only 'start' is understood",
        ),
        ({"start": (10, 0)}, ValueError, r"options\['start'\] \(10, 0\) is a wall"),
        ({"start": (20, 9)}, ValueError, r"options\['start'\] \(20, 9\) is the goal"),
        ({"start": (21, 0)}, ValueError, r"options\['start'\] \(21, 0\) is outside the map"),
        (
            {"start": None},
            TypeError,
            r"options\['start'\] must be a cell \(x, y\) of two integers, got None",
        ),
    ],
)
def test_bad_reset_options(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        GridWorld().reset(options=options)


def test_start_option_cut_off_from_the_goal() -> None:
    with pytest.raises(ValueError, match=r"options\['start'\] \(3, 0\) cannot reach the goal \(1, 0\)"):
        GridWorld("SG#.").reset(options={"start": (3, 0)})


@pytest.mark.parametrize("action", [-1, 4, 1.0, None, np.float32(1)])
def test_bad_actions(action: Any) -> None:
    env = GridWorld()
    env.reset()
    with pytest.raises(gymnasium.error.InvalidAction, match=r"action must be an integer in 0\.\.3, got "):
        env.step(action)


@pytest.mark.parametrize("action", [3, np.int64(3), np.array(3), Direction.RIGHT])
def test_integers_of_all_kinds_are_actions(action: Any) -> None:
    env = GridWorld("SG", success_probability=1)
    env.reset()
    assert env.step(action)[2]


def test_step_before_reset() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"step\(\) was called before the first reset\(\)"):
        GridWorld().step(0)


@pytest.mark.parametrize("action", [Direction.RIGHT, Direction.LEFT])
def test_step_after_the_end(action: Direction) -> None:
    env = GridWorld("SG", success_probability=1, max_steps=1)
    env.reset()
    env.step(action)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"after the episode's end: call reset\(\) first"):
        env.step(action)


def test_render_before_reset() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"render\(\) was called before the first reset"):
        GridWorld(render_mode="ansi").render()


def test_render_without_mode() -> None:
    env = GridWorld()
    env.reset()
    with pytest.warns(UserWarning, match=r"render\(\) does nothing without a render mode"):
        assert env.render() is None


def test_ansi() -> None:
    env = GridWorld("#####\n#KSD#\n##.G#\n#####", success_probability=1, render_mode="ansi", goal=(2, 2))
    env.reset()
    assert env.render() == "#####\n#KAD#\n##G.#\n#####"
    env.step(Direction.LEFT)
    assert env.render() == "#####\n#A..#\n##G.#\n#####"


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
    colours = [
        centre(start),
        centre(env.goal),
        centre((int(wall_x), int(wall_y))),
        centre(env.start_cells[1]),
    ]
    assert colours[:2] == [AGENT, GOAL]
    assert len(set(colours)) == 4


def test_pictures_follow_the_agent_and_the_key() -> None:
    env = GridWorld("KS.DG", success_probability=1, render_mode="rgb_array")
    env.reset()
    pictures = [env.render()]
    for action in (Direction.LEFT, Direction.RIGHT):
        env.step(action)
        pictures.append(env.render())
    without_key, picking_up, with_key = map(np.asarray, pictures)
    columns = [np.argwhere((p == AGENT).all(axis=2))[:, 1].mean() // RENDER_CELL_PX for p in map(np.asarray, pictures)]
    assert columns == [1, 0, 1]
    changed = (without_key != with_key).any(axis=(0, 2)).reshape(-1, RENDER_CELL_PX).any(axis=1)
    assert changed.tolist() == [True, False, False, True, False]
    assert (picking_up != with_key).any()


def test_human_shows_each_step_and_closes() -> None:
    env = GridWorld("S.G", success_probability=1, render_mode="human")
    env.metadata = {**env.metadata, "render_fps": 1000}
    env.reset()
    first = np.asarray(plt.gcf().axes[0].images[0].get_array()).copy()
    env.step(Direction.RIGHT)
    assert (np.asarray(plt.gcf().axes[0].images[0].get_array()) != first).any()
    assert env.render() is None
    env.close()
    env.close()
    assert plt.get_fignums() == []


def test_properties() -> None:
    env = GridWorld(goal=(20, 0))
    assert (env.width, env.height, env.goal) == (21, 10, (20, 0))
    assert env.walls.shape == (10, 21)
    assert env.doorways == [(10, 5)]
    assert len(env.start_cells) == 100
