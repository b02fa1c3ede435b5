"""The models of the command line take what SB3's classes take."""

import math
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env

from sb3_options.runs.algorithms import RESERVED, checked_arguments, make_model
from sb3_options.runs.config import ALGORITHMS, TrainConfig, build, configure
from sb3_options.runs.folder import make_env


def model_of(algo: str, **keywords: Any) -> BaseAlgorithm:
    config = configured(algo, **keywords)
    return make_model(config, make_env(config, 1, 0), playing=True)


def configured(algo: str, **keywords: Any) -> TrainConfig:
    return build({"algo": algo, "algo_kwargs": keywords}, "here")


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_class_is_given_arguments_that_have_no_setting(algo: str) -> None:
    model = model_of(algo, max_grad_norm=0.25) if algo != "trpo" else model_of(algo, cg_damping=0.25)
    assert 0.25 in (getattr(model, "max_grad_norm", None), getattr(model, "cg_damping", None))
    assert checked_arguments(algo, configure(algo=algo).algo_kwargs) == configure(algo=algo).algo_kwargs
    with pytest.raises(ValueError, match="there is no setting 'no_such_thing'"):
        configured(algo, no_such_thing=1)


@pytest.mark.parametrize(("algo", "n_steps"), [("dqn", 1), ("qrdqn", 1), ("optiondqn", 3)])
def test_returns_span_as_many_decisions_as_in_a_script(algo: str, n_steps: int) -> None:
    assert cast("Any", model_of(algo)).replay_buffer.n_steps == n_steps
    assert cast("Any", model_of(algo, n_steps=5)).replay_buffer.n_steps == 5


def test_arguments_of_the_policy_go_with_the_layers() -> None:
    model = model_of("ppo", policy_kwargs={"ortho_init": False})
    assert model.policy_kwargs == {"net_arch": [64, 64], "ortho_init": False}


@pytest.mark.parametrize(
    "name", [*sorted(RESERVED - {"env"}), "seed", "gamma", "learning_starts", "normalise_advantage"]
)
def test_what_is_no_argument_of_the_algorithm_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"there is no setting '{name}'"):
        configured("ppo", **{name: 1})


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("learning_rate", math.inf, "learning_rate.* should be a finite number"),
        ("learning_rate", "fast", "learning_rate.* should be"),
        ("n_steps", 1.5, "n_steps should be a valid integer"),
        ("policy_kwargs", 3, "policy_kwargs should be a valid dictionary"),
    ],
)
def test_values_are_checked_against_the_signature(name: str, value: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        configured("ppo", **{name: value})


def test_what_stable_baselines_refuses_is_one_line() -> None:
    with pytest.raises(ValueError, match="ppo: `batch_size` must be greater than 1"):
        model_of("ppo", batch_size=1, normalize_advantage=True)  # one advantage cannot be normalised


@pytest.mark.parametrize(
    ("shape", "dtype", "policy"),
    [
        ((7, 7, 3), np.uint8, "ActorCriticPolicy"),
        ((36, 40, 3), np.uint8, "ActorCriticCnnPolicy"),
        ((36, 40, 3), np.float32, "ActorCriticPolicy"),
    ],
)
def test_a_picture_too_small_for_convolutions_is_laid_flat(shape: tuple[int, ...], dtype: Any, policy: str) -> None:
    class Seen(gym.ObservationWrapper[Any, Any, Any]):
        def __init__(self, env: Any) -> None:
            super().__init__(env)
            self.observation_space = gym.spaces.Box(0, 255, shape, dtype)

        def observation(self, observation: Any) -> Any:
            return np.zeros(shape, dtype)

    venv = make_vec_env(lambda: Seen(gym.make("sb3_options/TwoRooms-v0")))
    model = make_model(build({"algo": "ppo"}, "here"), venv, playing=True)
    assert type(model.policy).__name__ == policy
    assert isinstance(model.predict(venv.reset())[0], np.ndarray)  # type: ignore[arg-type]
