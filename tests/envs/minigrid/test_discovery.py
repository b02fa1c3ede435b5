from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.discovery.methods.grouped import GroupedPeaks
from sb3_options.envs.minigrid import FEATURES, make
from sb3_options.options.option import SubgoalOption

SOON = {"start_radius": 0.5, "goal_radius": 0.5, "min_positive": 4, "decay": 0.5, "threshold": 0.5}


def venv_of(env_id: str, *, workers: bool = False, **slots: Any) -> Any:
    return make_vec_env(
        make, n_envs=2, seed=0, env_kwargs={"env_id": env_id}, wrapper_class=OptionsWrapper,
        wrapper_kwargs={"max_options": 2, **slots}, vec_env_cls=SubprocVecEnv if workers else DummyVecEnv,
    )  # fmt: skip


def discover(path: Path | None = None, *, workers: bool = False, **how: Any) -> SubgoalDiscoveryCallback:
    venv = venv_of("MiniGrid-Empty-Random-5x5-v0", workers=workers)
    model = MaskablePPO("MlpPolicy", venv, n_steps=128, batch_size=64, n_epochs=1, seed=0, device="cpu")
    callback = SubgoalDiscoveryCallback(SOON, **how)
    callback.save_path = path
    model.learn(2_500, callback=callback)
    venv.close()
    return callback


@pytest.mark.parametrize("workers", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_goal_ahead_is_discovered_and_its_option_is_good_in_another_map(workers: bool, tmp_path: Path) -> None:
    callback = discover(tmp_path / "options", workers=workers, max_new_options=1)
    assert callback.discovery is not None
    assert isinstance(callback.discovery.method, GroupedPeaks)
    (found,) = callback.discoveries
    assert found.where == "goal at forward 1, lateral 0"
    option = callback.bank[0]
    assert isinstance(option, SubgoalOption)
    assert option.policy_input == "features"
    assert option.initiation_set.points.shape[1] == 4  # with the cell ahead
    assert (option.initiation_set.points[:, 0] == 1).all()  # a goal that is not visible is nowhere
    # A larger map, observed otherwise: its observations have other numbers, its mission is another.
    larger = OptionsWrapper(make("MiniGrid-FourRooms-v0"), max_options=2, options_file=tmp_path / "options")
    loaded = larger.bank[0]
    assert isinstance(loaded, SubgoalOption)
    features = np.random.default_rng(0).integers(-3, 4, size=(500, len(FEATURES))).astype(float)
    np.testing.assert_array_equal(loaded.subgoal.contains(features), option.subgoal.contains(features))
    np.testing.assert_array_equal(loaded.initiation_set.contains(features), option.initiation_set.contains(features))
    assert loaded.subgoal.group == option.subgoal.group
    reached = runs(larger, 0, 60)
    assert len(reached) >= 20
    assert np.mean(reached) >= 0.7


def runs(env: OptionsWrapper, slot: int, n_episodes: int) -> list[bool]:
    """Whether the option reached its subgoal, each time that it could begin on a random walk."""
    rng = np.random.default_rng(0)
    reached = []
    for seed in range(n_episodes):
        env.reset(seed=seed)
        ended = False
        while not ended:
            action = int(rng.integers(3))
            if env.action_masks()[env.n_primitive + slot]:
                action = env.n_primitive + slot
            _, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
            if info["option"]["index"] == slot:
                reached.append(info["option"]["termination"] == "subgoal")
    return reached
