import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import config as configs
from sb3_options.config import TrainConfig
from sb3_options.discovery import DiscoverySettings
from sb3_options.option_learning import OptionLearningSettings

EVERY_FIELD_CHANGED = TrainConfig(
    algo="optiondqn", env="Taxi-v3", env_kwargs=("is_rainy:true", 'map:"S#\\nSG"', "max_steps:7"), n_timesteps=123,
    seed=9, tensorboard_log=Path("else/where"), n_envs=3, eval_freq=50, eval_episodes=4, progress=False, device="cpu",
    num_threads=2, options=Path("a/run"),
    max_options=2, max_new_options=None, discover=False, gamma=0.5, learning_rate=3e-05,
    buffer_size=77, learning_starts=11, batch_size=5, train_freq=6, target_update_interval=8,
    exploration_fraction=0.25, exploration_final_eps=0.125, net_arch=(3,),
    discovery=DiscoverySettings(
        segmentation="peaks", peak_reward=0.75, max_segment=70,
        capacity=7, min_positive=2, negative_bags=False, negative_strength=0.5, search="incremental", scale=2.5,
        start_radius=1.0, goal_radius=0.0, decay=0.75, threshold=0.25, peak_radius=2.0, peak_tolerance=0.01,
        subgoal_radius=1.25, spacing=1.5, max_places=6, max_extent=2.5,
        min_density=0.25,
    ),
    option=OptionLearningSettings(
        policy_input="features", initiation_steps=4, initiation_visits="every", initiation_radius=0.75, max_duration=9,
        step_reward=-2.0,
        subgoal_reward=3.0, leave_reward=-7.0, gamma=0.25, value_function="network", sweeps=3, network_updates=4,
        keep_learning=True, step_size=0.5,
    ),
)  # fmt: skip


def leaves(settings: Any, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            found |= leaves(value, f"{prefix}{field.name}.")
        else:
            found[prefix + field.name] = value
    return found


def test_every_field_survives_saving_and_loading(tmp_path: Path) -> None:
    default, changed = leaves(TrainConfig()), leaves(EVERY_FIELD_CHANGED)
    assert [name for name in default if changed[name] == default[name]] == []
    for config in (TrainConfig(), EVERY_FIELD_CHANGED, dataclasses.replace(TrainConfig(), net_arch=(), env_kwargs=())):
        configs.save(config, tmp_path / "config.yml")
        assert configs.load(tmp_path / "config.yml") == config
        assert configs.parse(["--config", str(tmp_path / "config.yml")]) == config


def test_flags_win_over_the_file_wherever_they_stand(tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    path.write_text("seed: 3\nn_timesteps: 500\ndiscover: false\ndiscovery:\n  capacity: 9\n  decay: 0.5\n")
    for args in (
        ["--config", str(path), "--seed", "4", "--discovery.decay", "0.25", "--discover"],
        ["--seed", "4", "--discovery.decay", "0.25", "--discover", f"--config={path}"],
    ):
        config = configs.parse(args)
        assert (config.seed, config.n_timesteps, config.discover) == (4, 500, True)
        assert (config.discovery.capacity, config.discovery.decay) == (9, 0.25)
    assert configs.parse([]) == TrainConfig()


def test_an_empty_file_means_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text("# nothing\n")
    assert configs.parse(["--config", str(tmp_path / "config.yml")]) == TrainConfig()


@pytest.mark.parametrize(
    "text",
    [
        "env_kwargs:\n  - 'map:\"S#\\nSG\"'\n  - max_steps:7\n  - goal:[1, 1]\n  - p:0.5\n  - note:a:b\n",
        "env_kwargs:\n  map: |-\n    S#\n    SG\n  max_steps: 7\n  goal: [1, 1]\n  p: 0.5\n  note: a:b\n",
    ],
    ids=["pairs", "mapping"],
)
def test_keyword_arguments_of_the_environment(text: str, tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    path.write_text(text)
    config = configs.parse(["--config", str(path)])
    expected = {"map": "S#\nSG", "max_steps": 7, "goal": [1, 1], "p": 0.5, "note": "a:b"}
    assert config.env_keywords() == expected
    configs.save(config, path)
    assert configs.load(path).env_keywords() == expected


def refusal(capsys: pytest.CaptureFixture[str], args: list[str]) -> str:
    with pytest.raises(SystemExit) as stopped:
        configs.parse(args)
    assert stopped.value.code != 0
    text = capsys.readouterr().err + (stopped.value.code if isinstance(stopped.value.code, str) else "")
    return " ".join(text.replace("│", " ").split())


class TestRefuses:
    def test_yaml_that_would_run_something(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        path, trace = tmp_path / "config.yml", tmp_path / "ran"
        path.write_text(f"seed: !!python/object/apply:os.mkdir ['{trace}']\n")
        text = refusal(capsys, ["--config", str(path)])
        assert "is no YAML that can be read safely" in text
        assert "python/object/apply:os.mkdir" in text
        assert not trace.exists()

    def test_the_same_in_keyword_arguments(self, tmp_path: Path) -> None:
        config = TrainConfig(env_kwargs=(f"map:!!python/object/apply:os.mkdir ['{tmp_path / 'ran'}']",))
        with pytest.raises(ValueError, match=r"--env-kwargs: the value of 'map' is no YAML that can be read safely"):
            config.env_keywords()
        assert not (tmp_path / "ran").exists()

    @pytest.mark.parametrize(
        ("key", "near"),
        [("n_timestep: 5", "--n-timesteps"), ("discovery:\n  capacitty: 5", "--discovery.capacity")],
    )
    def test_unknown_keys(self, key: str, near: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "config.yml").write_text(key + "\n")
        text = refusal(capsys, ["--config", str(tmp_path / "config.yml")])
        assert "Unrecognized" in text
        assert near in text

    def test_unknown_flags(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "--max-options" in refusal(capsys, ["--max-option", "3"])

    @pytest.mark.parametrize(
        ("content", "expected"),
        [
            ("- 1\n- 2\n", "must hold `name: value` lines, got a list"),
            ("just words\n", "must hold `name: value` lines, got a str"),
            ("a: [1\n", "is no YAML that can be read safely"),
            ("a: \x00\n", "is no YAML that can be read safely"),
        ],
    )
    def test_files_without_settings(
        self, content: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "config.yml").write_text(content)
        assert expected in refusal(capsys, ["--config", str(tmp_path / "config.yml")])

    def test_files_that_are_not_there(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "No such file" in refusal(capsys, ["--config", str(tmp_path / "none.yml")])
        assert "--config needs a file" in refusal(capsys, ["--config"])

    def test_files_that_are_no_text(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "config.yml").write_bytes(b"\xff\xfe\x00\x80")
        assert "config.yml" in refusal(capsys, ["--config", str(tmp_path / "config.yml")])

    @pytest.mark.parametrize(
        ("args", "expected"),
        [
            (["--n-timesteps", "0"], "--n-timesteps must be at least 1, got 0"),
            (["--n-envs", "-1"], "--n-envs must be at least 1, got -1"),
            (["--num-threads", "0"], "--num-threads must be at least 1, got 0"),
            (["--eval-freq", "-1"], "--eval-freq and --max-options must be at least 0"),
            (["--gamma", "1.5"], "--gamma must be in (0, 1], got 1.5"),
            (["--gamma", "nan"], "--gamma must be in (0, 1], got nan"),
            (["--learning-rate", "0"], "--learning-rate must be positive, got 0.0"),
            (["--exploration-fraction", "0"], "--exploration-fraction must be in (0, 1], got 0.0"),
            (["--exploration-final-eps", "2"], "--exploration-final-eps must be in [0, 1], got 2.0"),
            (["--env-kwargs", "map"], "--env-kwargs takes pairs name:value, got map"),
            (["--discovery.min-positive", "0"], "min_positive must be a whole number of at least 1, got 0"),
            (["--option.max-duration", "0"], "max_duration must be a whole number"),
            (["--algo", "sarsa"], "dqn"),
            (["--seed", "many"], "--seed"),
        ],
    )
    def test_values(self, args: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert expected in refusal(capsys, args)


def test_an_environment_brings_its_own_defaults_and_files_and_flags_win_over_them(tmp_path: Path) -> None:
    pioneer, file = "sb3_options/PioneerCorner-v0", tmp_path / "config.yml"
    shipped = configs.tuned(pioneer)
    assert shipped.discovery.scale == pytest.approx(11.46)
    assert configs.parse(["--env", pioneer]) == dataclasses.replace(shipped, env=pioneer)
    assert configs.parse(["--seed", "3", f"--env={pioneer}"]).discovery == shipped.discovery
    file.write_text(f"env: {pioneer}\ndiscovery:\n  scale: 3.0\n")
    from_file = configs.parse(["--config", str(file), "--gamma", "0.5"])
    assert (from_file.env, from_file.gamma, from_file.discovery.scale) == (pioneer, 0.5, 3.0)
    assert from_file.n_timesteps == shipped.n_timesteps
    assert configs.parse(["--config", str(file), "--env", "CartPole-v1"]).n_timesteps == TrainConfig.n_timesteps
    assert configs.parse([]) == TrainConfig()


def test_every_shipped_default_is_of_an_environment_there_is() -> None:
    for env_id in configs.TUNED:
        assert env_id in gym.registry
        assert configs.tuned(env_id) != TrainConfig()
