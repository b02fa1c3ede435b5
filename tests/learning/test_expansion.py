"""A model that got slots trains on; models and environments that get none are left as they were."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_options import OptionsWrapper, expand_action_space
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.learning.masked import n_actions_of
from tests.learning import expanded
from tests.support.sb3_helpers import (
    Corridor,
    env_of,
    fast_callback,
    optioned_rooms,
    places,
    small_rooms,
)


def test_environments_are_wrapped_beneath_whatever_stands_above() -> None:
    venv = VecNormalize(make_vec_env(small_rooms, 2, seed=0), gamma=expanded.GAMMA, clip_reward=np.inf)
    model = expanded.trained("dqn", venv, steps=256)
    count = cast("Any", venv.obs_rms).count
    expand_action_space(model, expanded.MAX_OPTIONS)
    assert env_of(model) is venv
    assert model.get_vec_normalize_env() is venv
    assert cast("Any", venv.obs_rms).count == count
    assert n_actions_of(model) == venv.action_space.n == expanded.N_ACTIONS
    for env in cast("DummyVecEnv", venv.unwrapped).envs:
        assert isinstance(env, OptionsWrapper)
        assert isinstance(env.env, Monitor)
        assert env.gamma == expanded.GAMMA
    model.learn(300, callback=fast_callback(), reset_num_timesteps=False)
    assert model.num_timesteps == 256 + 304  # whole train_freq's of 2 environments


def test_worker_processes_and_a_model_without_environment(tmp_path: Path) -> None:
    expanded.trained("dqn", steps=64).save(tmp_path / "model.zip")
    model = DQN.load(tmp_path / "model.zip")
    batch = expanded.random_observations(model, 3)
    before = expanded.outputs(model, batch)
    with pytest.raises(ValueError, match=r"model has no environment: give one to DQN.load\(..., env=...\), or pass "):
        expand_action_space(model, 4)
    workers = SubprocVecEnv([optioned_rooms])
    try:
        expand_action_space(model, 4, env=workers)
        assert env_of(model) is workers
        for a, b in zip(before, expanded.outputs(model, batch), strict=True):
            assert torch.equal(a, b[..., : expanded.N_PRIMITIVE])
        model.learn(64, callback=fast_callback(), reset_num_timesteps=False)
        assert model.num_timesteps == 128
    finally:
        workers.close()


def test_another_environment_takes_the_place_of_the_models() -> None:
    model = expanded.trained("dqn", steps=64)
    other = optioned_rooms(2)
    expand_action_space(model, 2, env=other)
    model.learn(64, callback=fast_callback(), reset_num_timesteps=False)
    (env,) = cast("DummyVecEnv", env_of(model)).envs
    assert isinstance(env, Monitor)
    assert env.env is other
    assert n_actions_of(model) == expanded.N_PRIMITIVE + 2


def test_masks_of_the_environment_itself_go_on() -> None:
    class Masked(Corridor):
        def action_masks(self) -> list[bool]:
            return [self.place > 0, True]

        def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            assert action == 1 or self.place > 0
            return super().step(action)

    kwargs = {**expanded.KINDS["maskableppo"].kwargs, "n_epochs": 1}
    model = MaskablePPO("MlpPolicy", Masked(), gamma=expanded.GAMMA, seed=0, **kwargs).learn(128)
    expand_action_space(model, 2)
    model.learn(256, callback=SubgoalDiscoveryCallback(max_new_options=0), reset_num_timesteps=False)
    masks = model.rollout_buffer.action_masks.reshape(-1, 4)
    assert not masks[:, 0].all()
    assert masks[:, 1].all()
    assert not masks[:, 2:].any()


class OwnReplay(ReplayBuffer):
    """A user's own."""


def test_bare_worker_processes_are_refused() -> None:
    workers = SubprocVecEnv([small_rooms])
    try:
        model = DQN("MlpPolicy", workers, buffer_size=10)
        text = r"of a SubprocVecEnv cannot be wrapped from here: pass env=.*gamma\": 0.99"
        with pytest.raises(ValueError, match=text):
            expand_action_space(model)
    finally:
        workers.close()


def test_errors_leave_the_model_as_it_was() -> None:
    model = expanded.small_model()
    weights = {key: value.clone() for key, value in model.policy.state_dict().items()}
    mine = model.replay_buffer
    smaller: Any = {"map": "SSS.\n...G", "max_steps": 9}
    wrong: dict[str, tuple[int, Any]] = {
        "max_options must be a whole number": (-1, {}),
        "env is not wrapped in OptionsWrapper: use OptionsWrapper": (4, {"env": small_rooms()}),
        "Action spaces do not match": (3, {"env": optioned_rooms(4)}),
        "discounts with gamma=0.5, DQN with gamma=0.9": (4, {"env": OptionsWrapper(small_rooms(), 4, gamma=0.5)}),
        "4 actions, env has 2 primitive actions": (4, {"env": OptionsWrapper(Corridor(), 4, gamma=expanded.GAMMA)}),
        "Observation spaces do not match": (4, {"env": optioned_rooms(4, **smaller)}),
        "trained with n_envs=1, env has 2: .* DQN.load": (4, {"env": make_vec_env(optioned_rooms, 2)}),
        "feature_map belongs to Opt": (4, {"env": optioned_rooms(4), "feature_map": places}),
    }
    for text, (max_options, kwargs) in wrong.items():
        with pytest.raises(ValueError, match=text):
            expand_action_space(model, max_options, **kwargs)
    with pytest.raises(TypeError, match="feature_map must be"):
        expand_action_space(model, 4, feature_map=cast("Any", 3))
    model.replay_buffer = OwnReplay(10, model.observation_space, model.action_space)
    with pytest.raises(ValueError, match=r"DQN was built with OwnReplay, .*: pass DQN\(\.\.\., replay_buffer_class="):
        expand_action_space(model)
    model.replay_buffer = mine
    assert n_actions_of(model) == expanded.N_PRIMITIVE
    assert not any(env_of(model).env_is_wrapped(OptionsWrapper))
    assert type(model.replay_buffer) is ReplayBuffer
    assert all(torch.equal(weights[key], value) for key, value in model.policy.state_dict().items())
    model.learn(20)


def test_slots_cannot_be_added_twice() -> None:
    model = expand_action_space(expanded.small_model(), 2)
    with pytest.raises(ValueError, match=r"is wrapped in OptionsWrapper already: among its 6 actions are option slots"):
        expand_action_space(model, 2)


def test_other_models_are_refused() -> None:
    class Continuous(Corridor):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = spaces.Box(-1.0, 1.0, (1,))

    with pytest.raises(TypeError, match=r"has no networks with an output for each of its actions, Box\(-1.0"):
        expand_action_space(PPO("MlpPolicy", Continuous(), n_steps=8, batch_size=8, device="cpu"))
    model = expanded.small_model().learn(8)
    model.policy.q_net.q_net.append(torch.nn.Tanh())
    with pytest.raises(TypeError, match="DQNPolicy changes the outputs of the last"):
        expand_action_space(model)
    model = expanded.small_model()
    model.policy.q_net_target = None
    with pytest.raises(TypeError, match="DQNPolicy has neither action_net"):
        expand_action_space(model)
