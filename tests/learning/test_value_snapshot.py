"""A snapshot's values are those of the network for what the algorithm sees."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_options import OptionDQN, OptionsWrapper
from sb3_options.learning.value_snapshot import ValueSnapshot, interrupt_options
from tests.support.sb3_helpers import TINY, Corridor, places


@pytest.mark.parametrize("kind", ["box", "dict_discrete"])
def test_observations_are_clipped_as_vec_normalize_clips_them(kind: str) -> None:
    """In a network with values of its own beyond the clip, where they would differ."""

    def make() -> OptionsWrapper:
        return OptionsWrapper(Corridor(kind), 1, gamma=0.9, feature_map=places)

    keys = {"norm_obs_keys": ["twice"]} if kind == "dict_discrete" else {}
    venv = VecNormalize(DummyVecEnv([make]), gamma=0.9, clip_obs=0.7, norm_reward=False, **keys)  # type: ignore[arg-type]  # one of two types
    policy = "MlpPolicy" if kind == "box" else "MultiInputPolicy"
    model = OptionDQN(policy, venv, gamma=0.9, **TINY)
    rng = np.random.default_rng(0)
    venv.reset()
    for _ in range(200):
        venv.step(rng.integers(2, size=1))
    snapshot, clipped = ValueSnapshot(model), 0
    for place in range(12):
        observation: Any = Corridor(kind).see(place)
        batch = {k: np.asarray(v)[None] for k, v in observation.items()} if kind != "box" else observation[None]
        normalized: Any = venv.normalize_obs(batch)
        seen = normalized["twice"] if kind != "box" else normalized
        clipped += bool((np.abs(seen) == np.float32(0.7)).any())
        with torch.no_grad():
            expected = model.q_net(model.policy.obs_to_tensor(normalized)[0])[0].numpy()
        np.testing.assert_allclose(snapshot(observation), expected, atol=1e-5)
    assert 2 <= clipped < 12


def test_a_model_without_an_environment_takes_the_wrappers_of_the_one_it_is_asked_for(tmp_path: Path) -> None:
    def make(observation: str) -> OptionsWrapper:
        return OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", observation=observation), 1, gamma=0.97)

    venv = VecNormalize(DummyVecEnv([lambda: make("xy")]), norm_reward=False)
    model = OptionDQN("MlpPolicy", venv, gamma=0.97, **TINY)
    venv.reset()
    for _ in range(20):
        venv.step(np.array([0]))
    model.save(tmp_path / "model.zip")
    alone = OptionDQN.load(tmp_path / "model.zip")
    place = np.array([3.0, 4.0], dtype=np.float32)
    with torch.no_grad():
        expected = model.q_net(model.policy.obs_to_tensor(venv.normalize_obs(place[None]))[0])[0].numpy()
    assert interrupt_options(alone, venv)
    for snapshot in (ValueSnapshot(alone, venv), venv.get_attr("slot_state")[0].interruption.values):
        np.testing.assert_allclose(snapshot(place), expected, atol=1e-5)

    pictures = DummyVecEnv([lambda: make("image")])
    model = OptionDQN("CnnPolicy", pictures, gamma=0.97, **TINY)
    model.save(tmp_path / "pictures.zip")
    alone = OptionDQN.load(tmp_path / "pictures.zip")
    picture, _ = make("image").reset(seed=0)
    with torch.no_grad():
        expected = model.q_net(model.policy.obs_to_tensor(picture)[0])[0].numpy()
    np.testing.assert_allclose(ValueSnapshot(alone, pictures)(picture), expected, atol=1e-5)
    np.testing.assert_allclose(ValueSnapshot(model)(picture), expected, atol=1e-5)
