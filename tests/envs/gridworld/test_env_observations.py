"""Observations of every kind, and the cell and the key that concept features read from them."""

import numpy as np
import pytest

from sb3_options.envs import FOUR_ROOMS, KEY_DOOR, KEY_FEATURE_SCALE, TWO_ROOMS, Direction, GridWorld
from tests.envs.gridworld.cells import KINDS, Kind, cell_of


def test_observation_spaces() -> None:
    def shape(map: str, kind: Kind) -> tuple[int, ...] | None:
        return GridWorld(map, observation=kind).observation_space.shape

    assert [shape(map, "onehot") for map in (TWO_ROOMS, KEY_DOOR)] == [(210,), (208,)]
    assert [shape(map, "xy") for map in (TWO_ROOMS, KEY_DOOR)] == [(2,), (3,)]
    assert [shape(map, "image") for map in (TWO_ROOMS, "SG")] == [(40, 84, 3), (36, 72, 3)]


@pytest.mark.parametrize("kind", KINDS)
def test_observations_may_be_kept(kind: Kind) -> None:
    env = GridWorld("S.G", observation=kind, success_probability=1)
    first, _ = env.reset()
    kept = first.copy()
    first[:] = 0
    assert cell_of(env, env.reset()[0]) == (0, 0)
    np.testing.assert_array_equal(env.reset()[0], kept)


@pytest.mark.parametrize("kind", KINDS)
def test_key_is_seen_and_is_lost_with_the_episode(kind: Kind) -> None:
    env = GridWorld("KS.DG", success_probability=1, observation=kind)
    observations = [env.reset()[0]]
    observations += [env.step(action)[0] for action in (Direction.LEFT, Direction.RIGHT)]
    observations += [env.reset()[0]]
    features = env.concept_features(np.stack(observations))
    assert features.tolist() == [[1, 0, 0], [0, 0, KEY_FEATURE_SCALE], [1, 0, KEY_FEATURE_SCALE], [1, 0, 0]]


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


def test_image_without_agent_is_refused() -> None:
    env = GridWorld("S.G", observation="image")
    images = np.stack([env.reset()[0]] * 3)
    images[1] = 0
    with pytest.raises(ValueError, match=r"observations\[1\] shows no agent: pass the environment's own"):
        env.concept_features(images)
