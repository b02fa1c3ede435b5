import dataclasses
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.runs import config as configs
from sb3_options.runs.algorithms import AlgorithmName
from sb3_options.runs.config import TrainConfig
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.options.creation import OptionLearningSettings

EVERY_FIELD_CHANGED = TrainConfig(
    algo="optiondqn", env="Taxi-v3", env_kwargs=("is_rainy:true", 'map:"S#\\nSG"', "max_steps:7"), n_timesteps=123,
    seed=9, tensorboard_log=Path("else/where"), n_envs=3, eval_freq=50, eval_episodes=4, progress=False, device="cpu",
    num_threads=2, vec_env="subproc", options=Path("a/run"),
    max_options=2, max_new_options=None, discover=False, gamma=0.5, learning_rate=3e-05,
    buffer_size=77, learning_starts=11, batch_size=5, train_freq=6, target_update_interval=8,
    exploration_fraction=0.25, exploration_final_eps=0.125, net_arch=(3,),
    max_option_exploration=0.25, interruption=False, teach_head=True, intra_option=True,
    discovery=DiscoverySettings(
        segmentation="peaks", peak_reward=0.75, max_segment=70,
        capacity=7, min_positive=2, negative_bags=False, negative_strength=0.5, leak=0.125, search="exhaustive",
        scale=2.5, start_radius=1.0, goal_radius=0.0, decay=0.75, threshold=0.25, peak_radius=2.0, peak_tolerance=0.01,
        subgoal_radius=1.25, spacing=1.5, max_places=6, max_extent=2.5,
        min_density=0.25,
    ),
    option=OptionLearningSettings(
        policy_input="features", initiation_steps=4, initiation_visits="every", initiation_radius=0.75, max_duration=9,
        step_reward=-2.0,
        subgoal_reward=3.0, leave_reward=-7.0, gamma=0.25, value_function="network", sweeps=3, network_updates=4,
        keep_learning=True, step_size=0.5, grow=True,
    ),
)  # fmt: skip

ON_POLICY = {"n_steps": 12, "gae_lambda": 0.5, "ent_coef": 0.125, "n_epochs": 3, "clip_range": 0.25}
EVERY_ON_POLICY_FIELD_CHANGED = TrainConfig(algo="recurrentppo", batch_size=5, close_harmful=True, **ON_POLICY)  # type: ignore[arg-type]  # of several types


MASKED = TrainConfig(algo="maskableppo", max_runs=3)


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
    assert [name for name in default if changed[name] == default[name]] == ["max_runs", *ON_POLICY, "close_harmful"]
    others = (EVERY_FIELD_CHANGED, EVERY_ON_POLICY_FIELD_CHANGED, TrainConfig(algo="a2c"), MASKED)
    for config in (TrainConfig(), *others, dataclasses.replace(TrainConfig(), net_arch=(), env_kwargs=())):
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
            (["--algo=maskableppo", "--max-runs", "0"], "--max-runs must be at least 1, got 0"),
            (["--num-threads", "0"], "--num-threads must be at least 1, got 0"),
            (["--eval-freq", "-1"], "--eval-freq and --max-options must be at least 0"),
            (["--gamma", "1.5"], "--gamma must be in (0, 1], got 1.5"),
            (["--gamma", "nan"], "--gamma must be in (0, 1], got nan"),
            (["--learning-rate", "0"], "--learning-rate must be positive, got 0.0"),
            (["--exploration-fraction", "0"], "--exploration-fraction must be in (0, 1], got 0.0"),
            (["--exploration-final-eps", "2"], "--exploration-final-eps must be in [0, 1], got 2.0"),
            (["--gae-lambda", "1.5", "--algo", "ppo"], "--gae-lambda must be in [0, 1], got 1.5"),
            (["--clip-range", "0", "--algo", "ppo"], "--clip-range must be positive, got 0.0"),
            (["--ent-coef", "-1", "--algo", "a2c"], "--ent-coef must be at least 0, got -1.0"),
            (["--n-steps", "0", "--algo", "trpo"], "--n-steps must be at least 1, got 0"),
            (
                ["--algo", "maskableppo", "--n-steps", "1", "--n-envs", "1"],
                "maskableppo normalises advantages, which takes two: --n-steps times --n-envs and --batch-size must be "
                "at least 2, got 1 times 1 and 256.",
            ),
            (["--algo", "ppo", "--batch-size", "1"], "at least 2, got 128 times 8 and 1."),
            (["--env-kwargs", "map"], "--env-kwargs takes pairs name:value, got map"),
            (["--discovery.min-positive", "0"], "min_positive should be greater than or equal to 1, got 0"),
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


class TestSettingsOfTheAlgorithm:
    @pytest.mark.parametrize(
        ("args", "expected"),
        [
            (
                ["--algo", "ppo", "--learning-starts", "9"],
                "--learning-starts has no effect on ppo: it is a setting of dqn, qrdqn, optiondqn. Leave it out.",
            ),
            (
                ["--n-epochs", "3"],
                "--n-epochs has no effect on dqn: it is a setting of ppo, maskableppo, recurrentppo. Leave it out.",
            ),
            (["--algo", "a2c", "--batch-size", "32"], "--batch-size has no effect on a2c"),
            (["--algo=trpo", "--ent-coef", "0.5"], "--ent-coef has no effect on trpo"),
            (
                ["--algo=ppo", "--no-interruption"],
                "--interruption has no effect on ppo: it is a setting of dqn, qrdqn,",
            ),
            (["--algo=ppo", "--max-option-exploration=1"], "--max-option-exploration has no effect on ppo"),
            (["--algo=ppo", "--max-runs=5"], "--max-runs has no effect on ppo: it is a setting of maskableppo."),
            (
                ["--algo=maskableppo", "--max-runs=5", "--discovery.segmentation=peaks"],
                "--max-runs counts in an episode, and a continuing task has none",
            ),
            (["--max-option-exploration=2"], "--max-option-exploration must be in [0, 1], got 2.0"),
            (
                ["--close-harmful", "--discovery.segmentation=peaks"],
                "--close-harmful compares episodes, and a continuing task has none",
            ),
        ],
    )
    def test_one_that_has_no_effect_is_refused(
        self, args: list[str], expected: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert expected in refusal(capsys, args)

    def test_in_a_file_too(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "config.yml").write_text("algo: qrdqn\ngae_lambda: 0.5\n")
        text = refusal(capsys, ["--config", str(tmp_path / "config.yml")])
        assert "--gae-lambda has no effect on qrdqn" in text

    def test_an_algorithm_brings_its_own_defaults(self, tmp_path: Path) -> None:
        ppo = configs.parse(["--algo", "ppo"])
        assert (ppo.algo, ppo.n_envs, ppo.batch_size, ppo.learning_rate) == ("ppo", 8, 256, 1e-3)
        assert configs.parse(["--algo", "ppo", "--n-envs", "2"]) == dataclasses.replace(ppo, n_envs=2)
        (tmp_path / "config.yml").write_text("algo: ppo\nn_steps: 64\n")
        from_file = configs.parse(["--config", str(tmp_path / "config.yml"), "--gamma", "0.9"])
        assert from_file == dataclasses.replace(ppo, n_steps=64, gamma=0.9)
        assert configs.parse(["--config", str(tmp_path / "config.yml"), "--algo", "a2c"]).batch_size == 64

    @pytest.mark.parametrize("algo", get_args(AlgorithmName))
    def test_every_algorithm_has_valid_defaults_for_every_environment(self, algo: AlgorithmName) -> None:
        for env_id in (*configs.TUNED, TrainConfig.env):
            config = configs.parse(["--algo", algo, "--env", env_id])
            assert (config.algo, config.env) == (algo, env_id)
            assert config.discovery == configs.tuned(env_id).discovery

    def test_what_was_tuned_for_another_algorithm_is_not_taken_over(self) -> None:
        pioneer = "sb3_options/Pioneer-v0"
        ppo, dqn = configs.tuned(pioneer, "ppo"), configs.tuned(pioneer)
        assert (dqn.train_freq, dqn.exploration_fraction) == (1, 0.3)
        assert (ppo.train_freq, ppo.exploration_fraction) == (TrainConfig.train_freq, TrainConfig.exploration_fraction)
        assert ppo.gamma == dqn.gamma == 0.95
