from typing import Any

import gymnasium as gym
import minigrid  # noqa: F401  # registers its environments
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from minigrid.wrappers import ViewSizeWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_options import OptionsWrapper
from sb3_options.envs.minigrid import FEATURES, MiniGridWrapper, make, retina

IDS = sorted(
    name for name in gym.registry if name.startswith("MiniGrid-") and "WFC" not in name  # those need networkx
)  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize("env_id", IDS)
def test_every_environment_is_one_vector(env_id: str) -> None:
    env = make(env_id)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        assert env.observation_space.contains(observation)
    assert env.concept_features(observation[None]).shape == (1, len(FEATURES))


def test_the_image_can_be_read_back_from_the_vector() -> None:
    inner: Any = ViewSizeWrapper(gym.make("MiniGrid-LockedRoom-v0"), agent_view_size=9)  # type: ignore[no-untyped-call]  # of minigrid
    env = MiniGridWrapper(inner)
    observation, _ = inner.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(50):
        vector = env.observation(observation)
        np.testing.assert_array_equal(env.images(vector[None])[0], observation["image"])
        np.testing.assert_array_equal(env.concept_features(vector[None]), retina(observation["image"][None]))
        observation = inner.step(rng.integers(7))[0]


def test_missions_differ_where_they_vary_and_only_there() -> None:
    env = make("MiniGrid-Fetch-5x5-N2-v0")
    base = env.observation_space.shape
    assert base == (7 * 7 * 21 + 5 + 6 + 2,)
    codes = {}
    for seed in range(30):
        observation, _ = env.reset(seed=seed)
        codes[env.unwrapped.mission] = observation[7 * 7 * 21 :].tobytes()  # type: ignore[attr-defined]
        assert observation[7 * 7 * 21 :].sum() == 3
    assert len(set(codes.values())) == len(codes) > 10
    assert make("MiniGrid-DoorKey-5x5-v0").observation_space.shape == (7 * 7 * 21,)


def test_without_the_mission_a_model_can_go_on_in_a_task_with_another() -> None:
    env = make("MiniGrid-LockedRoom-v0", mission=False)
    assert env.observation_space == make("MiniGrid-DoorKey-5x5-v0").observation_space
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert env.spec is not None
    assert env.spec.additional_wrappers[-1].kwargs == {"mission": False}


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


@pytest.mark.parametrize("workers", [False, True])
def test_it_is_ready_for_training_with_options(workers: bool) -> None:
    venv = make_vec_env(
        make, n_envs=2, env_kwargs={"env_id": "MiniGrid-DoorKey-5x5-v0"}, wrapper_class=OptionsWrapper,
        vec_env_cls=SubprocVecEnv if workers else None,
    )  # fmt: skip
    assert venv.env_method("feature_kind") == ["environment"] * 2
    PPO("MlpPolicy", venv, n_steps=16, batch_size=16, n_epochs=1, device="cpu").learn(32)
    venv.close()


def test_other_observations_are_refused() -> None:
    with pytest.raises(TypeError, match=r"needs observations of MiniGrid.*Put it right around gymnasium.make"):
        MiniGridWrapper(gym.make("CartPole-v1"))
