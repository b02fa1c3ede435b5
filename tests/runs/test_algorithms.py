"""The models of the command line take what SB3's classes take."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env

from sb3_options.runs.algorithms import RESERVED, check_algorithm, make_model, warn_without_gpu
from sb3_options.runs.config import CLASSES, TrainConfig, load, made, save
from sb3_options.runs.flags import parse
from sb3_options.runs.folder import make_env


def model_of(algo: str, **keywords: Any) -> BaseAlgorithm:
    config = configured(algo, **keywords)
    return make_model(config, make_env(config, 1, 0), playing=True)


def configured(algo: str, **keywords: Any) -> TrainConfig:
    return made({"algo": algo, "algo_kwargs": keywords}, "here")


@pytest.mark.parametrize("algo", CLASSES)
def test_every_class_takes_arguments_that_have_no_setting(algo: str) -> None:
    model = model_of(algo, max_grad_norm=0.25) if algo != "trpo" else model_of(algo, cg_damping=0.25)
    assert 0.25 in (getattr(model, "max_grad_norm", None), getattr(model, "cg_damping", None))
    with pytest.raises(ValueError, match="takes no 'no_such_thing' here"):
        check_algorithm(configured(algo, no_such_thing=1))


def test_arguments_of_the_policy_go_with_the_layers() -> None:
    model = model_of("ppo", policy_kwargs={"ortho_init": False})
    assert model.policy_kwargs == {"net_arch": [64, 64], "ortho_init": False}


def test_they_are_pairs_on_the_command_line_and_a_mapping_in_a_file(tmp_path: Path) -> None:
    config = parse(["ppo", "--algo-kwargs", "normalize_advantage:false", "target_kl:0.03"])
    assert config.algo_kwargs == {"normalize_advantage": False, "target_kl": 0.03}
    save(config, tmp_path / "config.yml")
    assert load(tmp_path / "config.yml") == config


@pytest.mark.parametrize("name", ["ent_coef", "seed", "device", "learning_rate", "net_arch"])
def test_what_has_a_setting_is_given_there(name: str) -> None:
    with pytest.raises(ValueError, match=f"'{name}' is a setting of its own, --{name.replace('_', '-')}"):
        check_algorithm(configured("ppo", **{name: 1}))


@pytest.mark.parametrize("name", sorted(RESERVED - {"env"}))
def test_what_the_library_gives_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"takes no {name!r} here"):
        check_algorithm(configured("dqn", **{name: 1}))


def test_a_slip_is_told_with_what_there_is() -> None:
    with pytest.raises(ValueError, match="Did you mean 'normalize_advantage'"):
        check_algorithm(configured("ppo", normalise_advantage=False))
    with pytest.raises(ValueError, match="policy_kwargs takes a mapping"):
        check_algorithm(configured("ppo", policy_kwargs=3))
    with pytest.raises(
        ValueError, match=r"features_extractor_class is a class or a function, which a script gives, got"
    ):
        check_algorithm(configured("ppo", policy_kwargs={"features_extractor_class": "sb3_options.x:MiniGridCNN"}))


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
    model = make_model(made({"algo": "ppo"}, "here"), venv, playing=True)
    assert type(model.policy).__name__ == policy
    assert isinstance(model.predict(venv.reset())[0], np.ndarray)  # type: ignore[arg-type]


def test_a_gpu_that_is_not_there_is_told_of(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    warn_without_gpu("auto")
    assert not caplog.records
    warn_without_gpu("cuda")
    assert caplog.messages == ["--device cuda: torch finds no GPU, so training is on the CPU."]
