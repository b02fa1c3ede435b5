"""Models and environments that get no slots, and are left as they were."""

from typing import Any, cast

import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_options import OptionsWrapper, expand_action_space
from sb3_options.learning.masked import n_actions_of
from tests.learning.expanded import GAMMA, N_PRIMITIVE, small_model
from tests.support.sb3_helpers import Corridor, env_of, optioned_rooms, places, small_rooms


class OwnReplay(ReplayBuffer):
    """A user's own."""


def bare_workers() -> Any:
    return small_rooms()


def test_bare_worker_processes_are_refused() -> None:
    workers = SubprocVecEnv([bare_workers])
    try:
        model = DQN("MlpPolicy", workers, buffer_size=10)
        text = r"of a SubprocVecEnv cannot be wrapped from here: pass env=.*gamma\": 0.99"
        with pytest.raises(ValueError, match=text):
            expand_action_space(model)
    finally:
        workers.close()


def test_errors_leave_the_model_as_it_was() -> None:
    model = small_model()
    weights = {key: value.clone() for key, value in model.policy.state_dict().items()}
    mine = model.replay_buffer
    smaller: Any = {"map": "SSS.\n...G", "max_steps": 9}
    wrong: dict[str, tuple[int, Any]] = {
        "max_options must be a whole number": (-1, {}),
        "env is not wrapped in OptionsWrapper: use OptionsWrapper": (4, {"env": small_rooms()}),
        "Action spaces do not match": (3, {"env": optioned_rooms(4)}),
        "discounts with gamma=0.5, DQN with gamma=0.9": (4, {"env": OptionsWrapper(small_rooms(), 4, gamma=0.5)}),
        "among 4 actions, env has 2 primitive actions": (4, {"env": OptionsWrapper(Corridor(), 4, gamma=GAMMA)}),
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
    assert n_actions_of(model) == N_PRIMITIVE
    assert not any(env_of(model).env_is_wrapped(OptionsWrapper))
    assert type(model.replay_buffer) is ReplayBuffer
    assert all(torch.equal(weights[key], value) for key, value in model.policy.state_dict().items())
    model.learn(20)


def test_slots_cannot_be_added_twice() -> None:
    model = expand_action_space(small_model(), 2)
    with pytest.raises(ValueError, match=r"is wrapped in OptionsWrapper already: among its 6 actions are option slots"):
        expand_action_space(model, 2)


def test_other_models_are_refused() -> None:
    class Continuous(Corridor):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = spaces.Box(-1.0, 1.0, (1,))

    with pytest.raises(TypeError, match=r"has no networks with an output for each of its actions, Box\(-1.0"):
        expand_action_space(PPO("MlpPolicy", Continuous(), n_steps=8, batch_size=8, device="cpu"))
    model = small_model().learn(8)
    model.policy.q_net.q_net.append(torch.nn.Tanh())
    with pytest.raises(TypeError, match="DQNPolicy changes the outputs of the last"):
        expand_action_space(model)
    model = small_model()
    model.policy.q_net_target = None
    with pytest.raises(TypeError, match="DQNPolicy has neither action_net"):
        expand_action_space(model)
