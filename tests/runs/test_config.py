import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.envs.minigrid import DISCOVERY
from sb3_options.options.settings import OptionLearningSettings, UsefulnessSettings
from sb3_options.runs import config as configs
from sb3_options.runs import shipped
from sb3_options.runs.config import (
    CLASSES,
    A2CConfig,
    DQNConfig,
    MaskablePPOConfig,
    PPOConfig,
    TrainConfig,
    TRPOConfig,
)

COMMON: dict[str, Any] = {
    "env": "Taxi-v3", "env_kwargs": {"is_rainy": True, "map": "S#\nSG", "max_steps": 7}, "n_timesteps": 123,
    "env_wrapper": "a_module:Wrapper", "feature_map": "a_module:phi", "eval_max_steps": 70, "checkpoint_freq": 60,
    "seed": 9, "tensorboard_log": Path("else/where"), "n_envs": 3, "eval_freq": 50, "eval_episodes": 4,
    "progress": False, "device": "cpu", "num_threads": 2, "vec_env": "subproc", "options": Path("a/run"),
    "max_options": 2, "max_new_options": None, "discover": False, "compare": True, "gamma": 0.5,
    "learning_rate": 3e-05, "net_arch": (3,), "bonus": "rnd",
    "success": "return:3",
    "algo_kwargs": {"max_grad_norm": 0.25},
    "discovery": DiscoverySettings(
        max_segment=70,
        max_share=0.125, capacity=7, max_bytes=99, method="l-cut", min_positive=2, negative_bags=False,
        search_growth=0.1, cut_threshold=0.5, negative_strength=0.5, leak=0.125, search="exhaustive",
        scale=2.5, start_radius=1.0, goal_radius=0.0, decay=0.8, threshold=0.25, peak_radius=2.0, peak_tolerance=0.01,
        subgoal_radius=1.25, spacing=1.5, max_places=6, max_extent=2.5,
        loops="keep", min_passing=0.25, min_cut=0.2, min_contrast=0.35, equal_time=False, salient_share=0.25,
    ),
    "option": OptionLearningSettings(
        policy_input="features", initiation_steps=4, initiation_visits="every", initiation_radius=0.75, max_duration=9,
        leave_reward=-7.0, gamma=0.25, value_function="network", sweeps=3, network_updates=4,
        grow=True, min_reach=0.25,
    ),
    "usefulness": UsefulnessSettings(judge=False, min_reached=0.25),
}  # fmt: skip

EVERY_FIELD_CHANGED: list[TrainConfig] = [
    DQNConfig(
        algo="optiondqn", buffer_size=77, learning_starts=11, batch_size=5, train_freq=6, target_update_interval=8,
        exploration_fraction=0.25, exploration_final_eps=0.125, max_option_exploration=0.25, interruption=False,
        n_steps=3, **COMMON,
    ),
    PPOConfig(
        algo="recurrentppo", n_steps=12, gae_lambda=0.5, ent_coef=0.125, n_epochs=3, clip_range=0.25, batch_size=5,
        **COMMON,
    ),
    MaskablePPOConfig(
        n_steps=12, gae_lambda=0.5, ent_coef=0.125, n_epochs=3, clip_range=0.25, batch_size=5, max_runs=3,
        max_option_exploration=0.25, **COMMON,
    ),
    A2CConfig(n_steps=12, gae_lambda=0.5, ent_coef=0.125, **COMMON),
    TRPOConfig(n_steps=12, gae_lambda=0.5, batch_size=5, **COMMON),
]  # fmt: skip


def leaves(settings: Any, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            found |= leaves(value, f"{prefix}{field.name}.")
        else:
            found[prefix + field.name] = value
    return found


@pytest.mark.parametrize("config", EVERY_FIELD_CHANGED, ids=lambda config: config.algo)
def test_every_field_survives_saving_and_loading(config: TrainConfig, tmp_path: Path) -> None:
    default, changed = leaves(type(config)()), leaves(config)  # type: ignore[call-arg]  # algo has a default
    unchanged = [name for name in default if changed[name] == default[name]]
    assert unchanged in (["discovery.segmentation"], ["algo", "discovery.segmentation"])
    continuing = DQNConfig(discovery=DiscoverySettings(segmentation="peaks"))
    for each in (config, type(config)(), continuing, dataclasses.replace(config, net_arch=())):  # type: ignore[call-arg]
        configs.save(each, tmp_path / "config.yml")
        trusted = {"env_wrapper": each.env_wrapper, "feature_map": each.feature_map}
        assert configs.load(tmp_path / "config.yml", trusted) == each


def test_saving_replaces_a_file_whole(tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    configs.save(DQNConfig(seed=1), path)
    unwritable = dataclasses.replace(DQNConfig(seed=2), env_kwargs={"a": object()})
    with pytest.raises(Exception, match="object"):
        configs.save(unwritable, path)
    assert configs.load(path).seed == 1
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "algo: qrdqn\ngae_lambda: 0.5\n",
            "--gae-lambda has no effect on qrdqn: it is a setting of ppo, recurrentppo, a2c, trpo, maskableppo. "
            "Leave it out.",
        ),
        ("algo: a2c\nbatch_size: 32\n", "--batch-size has no effect on a2c"),
    ],
)
def test_settings_of_other_algorithms_are_refused(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(ValueError, match=expected.replace(".", r"\.")) as error:
        configs.load(tmp_path / "config.yml")
    assert str(tmp_path / "config.yml") in str(error.value)


def test_an_environment_brings_its_own_defaults() -> None:
    pioneer = "sb3_options/PioneerCorner-v0"
    dqn, ppo = configs.tuned(pioneer), configs.tuned(pioneer, "ppo")
    assert isinstance(dqn, DQNConfig)
    assert dqn.env == ppo.env == pioneer
    assert dqn.discovery.scale == ppo.discovery.scale == pytest.approx(11.46)
    assert (dqn.train_freq, dqn.exploration_fraction) == (1, 0.3)
    assert dqn.gamma == ppo.gamma == 0.95
    for name in ("MiniGrid-Empty-5x5-v0", "minigrid:MiniGrid-Empty-5x5-v0"):
        for algo in CLASSES:
            grid = configs.tuned(name, algo)
            assert (grid.env, grid.gamma, grid.max_new_options, grid.discovery.capacity) == (name, 0.99, None, 500)
            assert grid.discovery == DiscoverySettings(**DISCOVERY["settings"])
            assert grid.option == OptionLearningSettings(**DISCOVERY["option_settings"])
            assert {"settings", "option_settings"} == set(DISCOVERY)
            assert grid.discovery.max_share == 0.06
    assert configs.tuned("CartPole-v1") == DQNConfig(env="CartPole-v1")


def test_every_shipped_default_is_of_an_environment_there_is() -> None:
    for env_id in shipped.TUNED:
        assert env_id in gym.registry
        assert configs.tuned(env_id) != DQNConfig(env=env_id)


@pytest.mark.parametrize(
    ("of", "values", "error", "text"),
    [
        (DQNConfig, {"n_timesteps": 0}, ValueError, "n_timesteps should be greater than or equal to 1, got 0"),
        (DQNConfig, {"seed": "many"}, ValueError, "seed should be a valid integer.*, got 'many'"),
        (DQNConfig, {"net_arch": [-1]}, ValueError, r"net_arch\.0 should be greater than or equal to 1, got -1"),
        (DQNConfig, {"discovery": 3}, ValueError, "discovery should be"),
        (PPOConfig, {"learning_starts": 9}, TypeError, "PPOConfig: there is no setting 'learning_starts'"),
        (PPOConfig, {"algo": "dqn"}, ValueError, "algo should be 'ppo' or 'recurrentppo', got 'dqn'"),
        (DQNConfig, {"env_kwargs": ["map"]}, ValueError, "--env-kwargs takes pairs name:value, got map"),
        (DQNConfig, {"net_arch": [True, 8]}, ValueError, "net_arch should be a number, got "),
        (DQNConfig, {"learning_rate": True}, ValueError, "DQNConfig: learning_rate should be a number, got True"),
        (DQNConfig, {"discovery": {"goal_radius": False}}, ValueError, r"discovery\.goal_radius should be a number"),
        (DiscoverySettings, {"min_positive": True}, ValueError, "min_positive should be a number, got True"),
        (DQNConfig, {"env_kwargs": 3}, ValueError, "env_kwargs should be a valid dictionary, got 3"),
    ],
)
def test_values_out_of_range_are_refused(of: Any, values: Any, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        of(**values)


def test_truth_values_in_files_are_no_numbers() -> None:
    for values in ({"learning_rate": True}, {"n_timesteps": True}, {"discovery": {"goal_radius": True}}):
        with pytest.raises(ValueError, match=r"^run\.yml: .* should be a number, got True\.$"):
            configs.made(values, "run.yml")
    assert (
        configs.made({"algo": "dqn", "discover": False, "env_kwargs": {"continuing": True}}, "run.yml").env_kwargs[
            "continuing"
        ]
        is True
    )


def test_keyword_arguments_are_read_as_yaml() -> None:
    pairs: Any = ("is_rainy:true", 'map:"S#\\nSG"', "max_steps:7", "p:0.5", "goal:[1, 1]", "note:a:b", "limit:None")
    expected = {
        "limit": None,
        "is_rainy": True,
        "map": "S#\nSG",
        "max_steps": 7,
        "p": 0.5,
        "goal": [1, 1],
        "note": "a:b",
    }
    assert DQNConfig(env_kwargs=pairs).env_kwargs == DQNConfig(env_kwargs=expected).env_kwargs == expected


def test_keyword_arguments_run_nothing(tmp_path: Path) -> None:
    pairs: Any = (f"map:!!python/object/apply:os.mkdir ['{tmp_path / 'ran'}']",)
    with pytest.raises(ValueError, match=r"--env-kwargs: the value of 'map' is no YAML that can be read safely"):
        DQNConfig(env_kwargs=pairs)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("content", "near"),
    [
        ({"min_pos": 3}, "discovery.min_positive"),
        ({"gama": 0.9}, "gamma"),
        ({"discovery": {"min_pos": 3}}, "discovery.min_positive"),
    ],
)
def test_the_nearest_name_is_told_whatever_part_it_is_of(content: dict[str, Any], near: str) -> None:
    with pytest.raises(ValueError, match=rf"there is no setting '.*'\. Did you mean '{near}'\?"):
        configs.made(content, "here")


def test_a_part_that_is_none_is_refused_beside_its_own_settings() -> None:
    with pytest.raises(ValueError, match=r"here: discovery should be .*got 5"):
        configs.made({"discovery": 5, "discovery.decay": 0.5}, "here")


def test_names_with_dots_are_those_of_parts() -> None:
    made = configs.made({"discovery.min_positive": 9, "discovery": {"decay": 0.5}, "option.grow": True}, "here")
    assert (made.discovery.min_positive, made.discovery.decay, made.option.grow) == (9, 0.5, True)
