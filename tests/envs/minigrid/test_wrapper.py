import re
from typing import Any

import gymnasium as gym
import minigrid.wrappers
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX
from minigrid.core.world_object import Lava
from stable_baselines3 import PPO

from sb3_options import OptionsWrapper
from sb3_options.envs.minigrid import FEATURES, MiniGridWrapper, make, retina
from sb3_options.envs.minigrid.cells import OBJECTS, STATES
from sb3_options.envs.minigrid.cnn import MiniGridCNN
from sb3_options.envs.minigrid.instructions import BEGINS, WORDS, Instructions
from sb3_options.envs.minigrid.missions import COLOURS, Missions, things_of

IDS = sorted(
    name for name in gym.registry if name.startswith("MiniGrid-") and "WFC" not in name  # their files are in no wheel
)  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize("env_id", IDS)
def test_every_environment_is_one_vector(env_id: str) -> None:
    env = make(env_id)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        assert env.observation_space.contains(observation)
    assert env.concept_features(observation[None]).shape == (1, len(env.feature_names))
    used = {n for group in env.concept_groups() for n in (*group["features"], *group["seen"]["features"])}
    unused = {n for n, name in enumerate(FEATURES) if name == "wall_ahead" or name.startswith("lava")}
    named = len(re.findall(rf"\b({'|'.join(COLOURS)})\b(?! goal)", env.unwrapped.mission))  # type: ignore[attr-defined]
    assert used == set(range(len(FEATURES) + 3 * named)) - unused


def test_without_the_mission_a_model_can_go_on_in_a_task_with_another() -> None:
    env = make("MiniGrid-LockedRoom-v0", mission=False)
    assert env.observation_space == make("MiniGrid-DoorKey-5x5-v0").observation_space
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert env.spec is not None
    assert env.spec.additional_wrappers[-1].kwargs == {"mission": False, "asked": True}


def test_success_is_reported_at_the_end() -> None:
    env = make("MiniGrid-Empty-5x5-v0")
    env.reset(seed=0)
    for action in (2, 2, 1, 2):
        info = env.step(action)[4]
        assert "is_success" not in info
    _, reward, terminated, _, info = env.step(2)
    assert terminated
    assert float(reward) > 0
    assert info["is_success"] is True
    env.reset(seed=0)
    infos = [env.step(0) for _ in range(100)]
    assert infos[-1][3]
    assert infos[-1][4]["is_success"] is False


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_it_passes_the_checks_of_gymnasium() -> None:
    check_env(make("MiniGrid-DoorKey-5x5-v0"), skip_render_check=True, skip_close_check=True)


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("ActionBonus", minigrid.wrappers.ActionBonus),
        ("PositionBonus", minigrid.wrappers.PositionBonus),
        ("TransformReward", lambda env: gym.wrappers.TransformReward(env, lambda reward: float(reward) + 1)),
    ],
)
def test_rewards_that_are_changed_are_refused_beneath_and_taken_above(name: str, changed: Any) -> None:
    """Else a death in the lava, with a bonus, would be a success."""
    text = (
        "MiniGridWrapper needs the rewards of MiniGrid, for an episode that ends with one above 0 is a success, got "
        f"those of {name}. Put {name} above it: {name}(MiniGridWrapper(gymnasium.make(...)), ...)."
    )
    with pytest.raises(TypeError, match=f"^{re.escape(text)}$"):
        MiniGridWrapper(changed(gym.make("MiniGrid-LavaGapS5-v0")))
    env = changed(make("MiniGrid-LavaGapS5-v0"))
    env.reset(seed=0)
    inner: Any = env.unwrapped
    inner.grid.set(*inner.front_pos, Lava())  # type: ignore[no-untyped-call]  # of minigrid
    _, reward, terminated, _, info = env.step(inner.actions.forward)
    assert terminated
    assert reward > 0
    assert info["is_success"] is False


def test_what_the_mission_asks_for_is_told_by_colour() -> None:
    """The agent of Fetch stands before things of all kinds; only one is the mission's."""
    env = make("MiniGrid-Fetch-8x8-N3-v0")
    inner: Any = env.unwrapped
    visible = 0
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        found = dict(zip(env.feature_names, env.concept_features(observation[None])[0], strict=True))
        image = env.images(observation[None])[0]
        cells = [
            (6 - row, column - 3)
            for column, row in np.argwhere(
                (image[..., 0] == OBJECT_TO_IDX[inner.targetType]) & (image[..., 1] == COLOR_TO_IDX[inner.targetColor])
            )
        ]
        assert found["asked_visible"] == bool(cells)
        if cells:
            nearest = min(abs(forward) + abs(lateral) for forward, lateral in cells)
            assert (found["asked_forward"], found["asked_lateral"]) in cells
            assert found["asked_forward"] + abs(found["asked_lateral"]) == nearest
            visible += 1
    assert 5 < visible < 20
    assert env.concept_groups()[-1]["name"] == "asked"
    assert env.concept_groups()[-1]["seen"]["coordinates"] == [28, 29]
    assert make("MiniGrid-Fetch-8x8-N3-v0", asked=False).feature_names == FEATURES


@pytest.mark.parametrize("view", [3, 7])
@pytest.mark.parametrize("env_id", ["MiniGrid-Empty-5x5-v0", "MiniGrid-Fetch-8x8-N3-v0", "MiniGrid-PutNear-6x6-N2-v0"])
def test_one_observation_has_the_features_that_it_has_among_many(env_id: str, view: int) -> None:
    env = make(env_id, agent_view_size=view)
    rng = np.random.default_rng(0)
    images = rng.integers((OBJECTS, len(COLOURS), STATES), size=(1000, view, view, 3)).astype(np.uint8)
    images[..., 0][rng.random((1000, view, view)) < 0.7] = 1  # empty
    cells = env.get_wrapper_attr("vectors")(images)
    words = np.array([env.reset(seed=seed)[0][cells.shape[1] :] for seed in range(20)]).repeat(50, axis=0)
    many = np.concatenate([cells, words], axis=1)
    features = env.get_wrapper_attr("concept_features")
    np.testing.assert_array_equal(np.concatenate([features(one[None]) for one in many]), features(many))
    other = rng.integers(0, 2, size=(100, many.shape[1])).astype(np.uint8)  # no views of MiniGrid
    np.testing.assert_array_equal(np.concatenate([features(one[None]) for one in other]), features(other))


def test_features_are_the_same_in_every_task() -> None:
    named = make("MiniGrid-RedBlueDoors-6x6-v0")
    assert len(named.feature_names) == 36
    assert len(named.concept_groups()) == len(make("MiniGrid-Empty-5x5-v0").concept_groups()) + 2
    for env in (make("MiniGrid-Fetch-8x8-N3-v0", mission=False), make("MiniGrid-Empty-5x5-v0")):
        assert env.feature_names == named.feature_names
        observation, _ = env.reset(seed=0)
        for batch in (observation[None], np.stack([observation] * 3)):
            features = env.concept_features(batch)
            assert np.array_equal(features[:, :27], retina(env.images(batch)))
            assert not features[:, 27:].any()


@pytest.mark.parametrize(
    ("env_id", "mission", "things"),
    [
        ("MiniGrid-RedBlueDoors-6x6-v0", None, [(4, 0), (4, 2)]),
        ("MiniGrid-GoToDoor-5x5-v0", "go to the grey door", [(4, 5)]),
        ("MiniGrid-PutNear-6x6-N2-v0", "put the red ball near the blue key", [(6, 0), (5, 2)]),
        ("MiniGrid-DoorKey-5x5-v0", None, []),
        ("MiniGrid-LavaCrossingS9N1-v0", None, []),
        (
            "MiniGrid-LockedRoom-v0",
            "get the red key from the blue room, unlock the red door and go to the goal",
            [(5, 0), (4, 2), (4, 0)],
        ),
    ],
)
def test_things_that_missions_name(env_id: str, mission: str | None, things: list[tuple[int, int]]) -> None:
    missions = Missions(gym.make(env_id).observation_space["mission"])  # type: ignore[index]  # a Dict
    code = missions.codes[0] if mission is None else missions.code(mission)
    assert code is not None
    assert things_of([missions.things_in(code.tobytes())]).tolist() == [list(map(list, things))]
    if mission is not None:
        assert things_of([missions.things_in(np.ones_like(code).tobytes())]).tolist() == [[[0, -1]] * len(things)]


@pytest.mark.parametrize(
    ("mission", "things"),
    [
        ("go to the red ball", [(6, 0), (0, -1)]),
        ("pick up a grey object behind you", [(0, 5), (0, -1)]),
        ("put the ball on your left next to a green box", [(0, -1), (7, 1)]),
        ("open a door, then go to the red key", [(0, -1), (0, -1)]),
        ("go to the red key after you open a blue door and pick up a box", [(4, 2), (0, -1)]),
    ],
)
def test_things_that_an_instruction_names(mission: str, things: list[tuple[int, int]]) -> None:
    code = Instructions().code(mission)
    assert code is not None
    assert things_of([Instructions().things_in(code.tobytes())]).tolist() == [list(map(list, things))]


def test_instructions_in_the_order_in_which_they_are_followed() -> None:
    codes = [
        Instructions().code(mission)
        for mission in (
            "go to the red key after you open a blue door and pick up a box",
            "open the blue door and pick up the box, then go to a red key",
            "go to the red key, then open a blue door and pick up a box",
        )
    ]
    same, again, other = (code.tolist() for code in codes if code is not None)
    assert same == again != other


@pytest.mark.parametrize(
    "mission",
    [
        "",
        "go to the goal",
        "open a door, then",
        "open a door and open a box and go to a key",
        "open a door" + ", then open a box" * 2,
    ],
)
def test_other_missions_have_no_code(mission: str) -> None:
    assert Instructions().code(mission) is None


@pytest.mark.parametrize("level", sorted(env_id for env_id in gym.registry if env_id.startswith("BabyAI-")))
def test_every_mission_of_babyai_can_be_read_from_its_code(level: str) -> None:
    env = make(level)
    for seed in range(8):
        observation, _ = env.reset(seed=seed)
        assert observation in env.observation_space
        mission = re.sub(r"\b(the|a) ", "", env.unwrapped.mission)  # type: ignore[attr-defined]
        later, after, sooner = mission.partition(" after you ")
        assert _text(observation[-Instructions.n_words :]) == (f"{sooner}, then {later}" if after else mission)


def _text(code: npt.NDArray[np.uint8]) -> str:
    """The mission that a code stands for, without articles."""
    sides = code.reshape(2, -1, BEGINS[-1])
    return ", then ".join(" and ".join(_instruction(row) for row in side if row.any()) for side in sides if side.any())


def _instruction(row: npt.NDArray[np.uint8]) -> str:
    parts = np.split(row, BEGINS[1:-1])
    verb, *words = (
        " ".join(word for word, one in zip(of, part, strict=True) if one) for of, part in zip(WORDS, parts, strict=True)
    )
    first, second = (" ".join(filter(None, thing)) for thing in (words[:3], words[3:]))
    return f"{verb} {first}" + (f" next to {second}" if second else "")


def test_convolutions_read_the_cells_as_a_picture() -> None:
    for env_id, n_words in (("MiniGrid-DoorKey-5x5-v0", 0), ("MiniGrid-Fetch-5x5-N2-v0", 13)):
        env = make(env_id)
        observation, _ = env.reset(seed=0)
        network = MiniGridCNN(env.observation_space)
        seen: list[torch.Tensor] = []
        network.cnn.register_forward_hook(lambda _, given, __: seen.append(given[0]))  # noqa: B023  # called here
        features = network(torch.as_tensor(observation[None], dtype=torch.float32))
        assert features.shape == (1, network.features_dim) == (1, 64 + n_words)
        (picture,) = seen
        objects = picture[0, :OBJECTS].argmax(dim=0).numpy()
        np.testing.assert_array_equal(objects, env.images(observation[None])[0, ..., 0])
    assert MiniGridCNN(gym.spaces.Box(0, 1, (1719,)), view=9).view == 9
    for n_numbers in (500, 1719, 2 * 1029):
        with pytest.raises(ValueError, match=f"1029 numbers for a view of 7 by 7 cells and some for .* {n_numbers}"):
            MiniGridCNN(gym.spaces.Box(0, 1, (n_numbers,)))
    optioned = OptionsWrapper(make("MiniGrid-DoorKey-5x5-v0"), max_options=2, gamma=0.99)
    how = {"features_extractor_class": MiniGridCNN}
    PPO("MlpPolicy", optioned, n_steps=16, batch_size=16, n_epochs=1, device="cpu", policy_kwargs=how).learn(32)
