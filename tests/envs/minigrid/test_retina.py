from typing import Any

import gymnasium as gym
import minigrid  # noqa: F401  # registers its environments
import numpy as np
import numpy.typing as npt
import pytest

from sb3_options.density.groups import FeatureGroup
from sb3_options.envs.minigrid import FEATURES, concept_groups, retina

EMPTY, WALL, DOOR, KEY, GOAL = 1, 2, 4, 5, 8
Image = npt.NDArray[np.uint8]


def image(things: dict[tuple[int, int], tuple[int, int]] | None = None, view: int = 7) -> Image:
    """An empty view with things by (forward, lateral): object and state."""
    cells = np.zeros((view, view, 3), dtype=np.uint8)
    cells[..., 0] = EMPTY
    for (forward, lateral), (thing, state) in (things or {}).items():
        cells[view // 2 + lateral, view - 1 - forward] = thing, 0, state
    return cells


def seen(cells: Image) -> dict[str, float]:
    """The features that are not 0, by name."""
    return {name: float(x) for name, x in zip(FEATURES, retina(cells[None])[0], strict=True) if x != 0}


@pytest.mark.parametrize(
    ("things", "expected"),
    [
        ({}, {"free_ahead": 1}),
        ({(1, 0): (WALL, 0)}, {"wall_ahead": 1}),
        ({(1, 0): (DOOR, 1)}, {"closed_door_visible": 1, "closed_door_forward": 1}),
        ({(1, 0): (DOOR, 0)}, {"open_door_visible": 1, "open_door_forward": 1, "free_ahead": 1}),
        (
            {(2, -1): (DOOR, 2)},
            {"locked_door_visible": 1, "locked_door_forward": 2, "locked_door_lateral": -1, "free_ahead": 1},
        ),
        ({(0, 0): (KEY, 0)}, {"key_visible": 1, "free_ahead": 1}),  # carried
        ({(0, -1): (WALL, 0), (0, 1): (WALL, 0)}, {"between_walls": 1, "free_ahead": 1}),
        ({(0, -1): (WALL, 0)}, {"free_ahead": 1}),
        ({(1, 0): (GOAL, 0)}, {"goal_visible": 1, "goal_forward": 1, "free_ahead": 1}),
        # The nearest counts, in steps.
        ({(4, 0): (KEY, 0), (1, 2): (KEY, 0)}, {"key_visible": 1, "key_forward": 1, "key_lateral": 2, "free_ahead": 1}),
    ],
)
def test_features_by_name(things: dict[tuple[int, int], tuple[int, int]], expected: dict[str, float]) -> None:
    assert seen(image(things)) == expected
    assert seen(image(things, view=9)) == expected


def test_it_agrees_with_what_lies_in_the_grid() -> None:
    """The view is turned towards where the agent looks: what is ahead is at forward 1, lateral 0."""
    env: Any = gym.make("MiniGrid-DoorKey-5x5-v0").unwrapped
    rng = np.random.default_rng(1)
    ahead = 0
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        for _ in range(20):
            observation = env.step(rng.integers(3))[0]
            features = seen(observation["image"])
            there = env.grid.get(*env.front_pos)
            assert features.get("wall_ahead", 0) == (there is not None and there.type == "wall")
            if there is not None and there.type == "key":
                ahead += 1
                position = features["key_visible"], features["key_forward"], features.get("key_lateral", 0)
                assert position == (1, 1, 0)
    assert ahead > 5


def test_options_see_the_cell_ahead_and_those_for_open_doors_closed_ones() -> None:
    groups = {group["name"]: FeatureGroup(**group) for group in concept_groups()}
    for group in groups.values():
        assert FEATURES[group.sees.features[len(group.features)]] == "free_ahead"
    door = groups["open_door"]
    views = [image(), image({(2, 1): (DOOR, 1)}), image({(2, 1): (DOOR, 0)}), image({(2, 1): (DOOR, 2)})]
    features = retina(np.stack(views))
    np.testing.assert_array_equal(door.is_place(features), [False, False, True, False])
    np.testing.assert_array_equal(door.sees.is_place(features), [False, True, True, False])


def test_a_doorway_is_between_walls_whatever_is_in_view_and_an_open_door_leads_there() -> None:
    (doorway,) = (FeatureGroup(**group) for group in concept_groups() if group["name"] == "doorway")
    between = {(0, -1): (WALL, 0), (0, 1): (WALL, 0)}
    views = [image(), image({(2, 1): (DOOR, 0)}), image(between), image(between | {(3, 0): (DOOR, 0)})]
    features = retina(np.stack(views))
    np.testing.assert_array_equal(doorway.is_place(features), [False, False, True, True])
    np.testing.assert_array_equal(doorway.own(features)[2], doorway.own(features)[3])
    np.testing.assert_array_equal(doorway.sees.is_place(features), [False, True, True, True])


def test_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"images must have shape \(batch, v, v, 3\).*got \(7, 7, 3\)"):
        retina(image())
