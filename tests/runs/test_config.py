import dataclasses
import os
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import logged_trajectory, save_demonstrations
from sb3_options.checkpoints.demonstrations import MANY
from sb3_options.cli import parse
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.envs.minigrid import DISCOVERY
from sb3_options.learning.novelty import NoveltyKind
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.runs import config as configs
from sb3_options.runs.config import ALGORITHMS, FIELDS, TrainConfig, configure


def test_every_field_survives_saving_and_loading(tmp_path: Path) -> None:
    config = configure(
        algo="maskableppo", env="Taxi-v3", env_kwargs={"is_rainy": True, "map": "S#\nSG"}, n_timesteps=123, seed=9,
        env_wrapper="a_module:Wrapper", feature_map="a_module:phi", checkpoint_freq=60, n_envs=3,
        tensorboard_log=Path("else/where"), eval_freq=50, eval_episodes=4, progress=False,
        vec_env="subproc", options=Path("a/run"), demonstrations=Path("shown"), clone=False, max_options=2,
        max_new_options=None, max_runs=7, gamma=0.5, bonus="rnd", success="return:3",
        n_steps=12, clip_range=0.25, policy_kwargs={"ortho_init": False}, net_arch=[3],
        discovery={"decay": 0.8, "scale": 2.5}, option={"max_duration": 9}, usefulness={"min_reached": 0.3},
    )  # fmt: skip
    changed = {f.name for f in dataclasses.fields(config) if getattr(config, f.name) != getattr(configure(), f.name)}
    assert changed == {*FIELDS} - {"algo"}
    trusted = {"env_wrapper": config.env_wrapper, "feature_map": config.feature_map}
    for each in (config, configure(algo="dqn"), configure(discovery={"segmentation": "peaks"})):
        configs.save(each, tmp_path / "config.yml")
        assert configs.load(tmp_path / "config.yml", trusted if each is config else {}) == each


@pytest.mark.parametrize("algo", ["maskableppo", "ppo", "a2c", "trpo", "recurrentppo", "dqn"])
def test_a_cloned_policy_gets_settings_of_its_own(algo: str) -> None:
    usual = configure(algo=algo).algo_kwargs
    expected = dict(usual)
    if algo in ("maskableppo", "ppo", "a2c"):
        expected |= {"ent_coef": 0.0, "learning_rate": 3e-4}
    elif algo == "trpo":  # it has no bonus, and its updates are limited
        expected |= {"learning_rate": 3e-4}
    elif algo == "dqn":  # random actions would leave the demonstrated way
        expected |= {"exploration_initial_eps": 0.05, "learning_starts": 0}
    assert configure(algo=algo, demonstrations="a").algo_kwargs == expected
    assert configure(algo=algo, demonstrations="a", clone=False).algo_kwargs == usual
    assert configure(algo=algo, demonstrations="a").max_runs == (5 if algo == "maskableppo" else None)
    assert configure(algo=algo, demonstrations="a", clone=False).max_runs is None
    assert configure(algo=algo, demonstrations="a", discovery={"segmentation": "peaks"}).max_runs is None
    assert configure(algo=algo, demonstrations="a", learning_rate=0.5).algo_kwargs["learning_rate"] == 0.5


@pytest.mark.parametrize(("n", "rate", "max_runs"), [(MANY, 1e-4, 15), (MANY - 1, 3e-4, 5)])
def test_a_policy_cloned_from_many_demonstrations_learns_with_small_updates(
    tmp_path: Path, n: int, rate: float, max_runs: int
) -> None:
    """Failures do not count, nor does a file that cannot be read."""
    path = tmp_path / "shown"
    shown = [logged_trajectory(np.eye(3), [0, 1], [0.0, float(i < n)], terminated=True) for i in range(n + 20)]
    save_demonstrations(path, shown)
    assert configure(demonstrations=path).algo_kwargs["learning_rate"] == rate
    assert configure(demonstrations=path).max_runs == max_runs
    assert configure(demonstrations=path, learning_rate=0.5).algo_kwargs["learning_rate"] == 0.5
    assert configure(demonstrations=path, success="steps:2").algo_kwargs["learning_rate"] == rate
    assert configure(demonstrations=path, success="steps:1").algo_kwargs["learning_rate"] == 3e-4
    assert configure(algo="trpo", demonstrations=path).algo_kwargs["learning_rate"] == 3e-4
    assert configure(demonstrations=path, discovery=DiscoverySettings(segmentation="peaks")).max_runs is None
    path.write_bytes(b"damaged")
    assert configure(demonstrations=path).algo_kwargs["learning_rate"] == 3e-4


@pytest.mark.parametrize("wrong", [{"demonstrations": 5}, {"success": 5}, {"success": None}], ids=str)
def test_demonstrations_are_not_looked_for_by_what_is_no_path_or_rule(tmp_path: Path, wrong: dict[str, Any]) -> None:
    path = tmp_path / "shown"
    save_demonstrations(path, [logged_trajectory(np.eye(3), [0, 1], [0.0, 1.0], terminated=True)])
    (name,) = wrong
    with pytest.raises(ValueError, match=f"^settings: {name} "):
        configure(**{"demonstrations": path, **wrong})


def test_a_pipe_is_not_read_to_learn_how_many_demonstrations_there_are(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    assert configure(demonstrations=path).algo_kwargs["learning_rate"] == 3e-4


def test_an_environment_brings_its_own_defaults() -> None:
    pioneer = "sb3_options/PioneerCorner-v0"
    dqn, ppo = configure(env=pioneer), configure(env=pioneer, algo="ppo")
    assert dqn.discovery.scale == ppo.discovery.scale == pytest.approx(11.46)
    assert (dqn.algo_kwargs["train_freq"], dqn.algo_kwargs["exploration_fraction"]) == (1, 0.3)
    assert "train_freq" not in ppo.algo_kwargs
    assert dqn.gamma == ppo.gamma == 0.95
    for name in ("MiniGrid-Empty-5x5-v0", "minigrid:MiniGrid-Empty-5x5-v0"):
        for algo in ALGORITHMS:
            grid = configure(env=name, algo=algo)
            assert (grid.env, grid.gamma, grid.max_new_options, grid.discovery.capacity) == (name, 0.99, None, 500)
            assert grid.discovery == DiscoverySettings(**DISCOVERY["settings"])
            assert grid.option == OptionLearningSettings(**DISCOVERY["option_settings"])
            assert {"settings", "option_settings"} == set(DISCOVERY)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"seed": "many"}, "seed should be a valid integer.*, got 'many'"),
        ({"discovery": 3}, "discovery should be"),
        ({"discovery": 5, "discovery.decay": 0.5}, "discovery should be .*got 5"),
    ],
)
def test_values_out_of_range_are_refused(values: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=rf"^run\.yml: .*{text}"):
        configs.build(values, "run.yml")


def test_keyword_arguments_run_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has the tag or anchor"):
        parse(["--env-kwargs", f"map:!!python/object/apply:os.mkdir ['{tmp_path / 'ran'}']"])
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
        configs.build(content, "here")


def test_every_kind_of_bonus_can_be_chosen() -> None:
    assert get_args(get_type_hints(TrainConfig)["bonus"]) == ("none", *get_args(NoveltyKind))
