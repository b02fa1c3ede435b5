import dataclasses
import re
from pathlib import Path

import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.runs import config as configs
from sb3_options.runs import shipped
from sb3_options.runs.config import CLASSES, GROUPS, A2CConfig, DQNConfig, MaskablePPOConfig, PPOConfig, TrainConfig
from sb3_options.runs.flags import parse


def test_flags_win_over_the_file_wherever_they_stand(tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    path.write_text("algo: dqn\nseed: 3\nn-timesteps: 500\ndiscover: false\ndiscovery:\n  capacity: 9\n  decay: 0.5\n")
    for args in (
        ["--config", str(path), "--seed", "4", "--discovery.decay", "0.25", "--discover"],
        ["--seed", "4", "--discovery.decay", "0.25", "--discover", f"--config={path}"],
        ["dqn", "--seed", "4", "--config", str(path), "--discovery.decay", "0.25", "--discover"],
    ):
        config = parse(args)
        assert (config.seed, config.n_timesteps, config.discover) == (4, 500, True)
        assert (config.discovery.capacity, config.discovery.decay) == (9, 0.25)
    assert parse([]) == MaskablePPOConfig()


def test_an_empty_file_means_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text("# nothing\n")
    assert parse(["--config", str(tmp_path / "config.yml")]) == MaskablePPOConfig()


@pytest.mark.parametrize("algo", CLASSES)
def test_a_saved_configuration_is_read_back(algo: str, tmp_path: Path) -> None:
    config = parse([algo, "--seed", "5", "--env-kwargs", "max_steps:7", "--options", "a/run", "--net-arch", "3"])
    assert (config.algo, config.seed, config.env_kwargs, config.net_arch) == (algo, 5, {"max_steps": 7}, (3,))
    configs.save(config, tmp_path / "config.yml")
    assert parse(["--config", str(tmp_path / "config.yml")]) == config


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
    config = configs.load(path)
    expected = {"map": "S#\nSG", "max_steps": 7, "goal": [1, 1], "p": 0.5, "note": "a:b"}
    assert config.env_kwargs == expected
    configs.save(config, path)
    assert configs.load(path).env_kwargs == expected


def refusal(capsys: pytest.CaptureFixture[str], args: list[str]) -> str:
    with pytest.raises(SystemExit) as stopped:
        parse(args)
    assert stopped.value.code != 0
    text = capsys.readouterr().err + (stopped.value.code if isinstance(stopped.value.code, str) else "")
    return " ".join(text.replace("│", " ").split())


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--n-timesteps", "0"], "n_timesteps should be greater than or equal to 1, got 0"),
        (["--n-envs", "-1"], "n_envs should be greater than or equal to 1, got -1"),
        (["maskableppo", "--max-runs", "0"], "max_runs should be greater than or equal to 1, got 0"),
        (["--num-threads", "0"], "num_threads should be greater than or equal to 1, got 0"),
        (["--eval-freq", "-1"], "eval_freq should be greater than or equal to 0, got -1"),
        (["--gamma", "1.5"], "gamma should be less than or equal to 1, got 1.5"),
        (["--gamma", "nan"], "gamma should be less than or equal to 1, got nan"),
        (["--learning-rate", "0"], "learning_rate should be greater than 0, got 0.0"),
        (["dqn", "--exploration-fraction", "0"], "exploration_fraction should be greater than 0, got 0.0"),
        (["dqn", "--exploration-final-eps", "2"], "exploration_final_eps should be less than or equal to 1, got 2.0"),
        (["--max-option-exploration=2"], "max_option_exploration should be less than or equal to 1, got 2.0"),
        (["ppo", "--gae-lambda", "1.5"], "gae_lambda should be less than or equal to 1, got 1.5"),
        (["ppo", "--clip-range", "0"], "clip_range should be greater than 0, got 0.0"),
        (["--ent-coef", "-1", "--algo", "a2c"], "ent_coef should be greater than or equal to 0, got -1.0"),
        (["--n-steps", "0", "--algo", "trpo"], "n_steps should be greater than or equal to 1, got 0"),
        (
            ["--algo", "maskableppo", "--n-steps", "1", "--n-envs", "1"],
            "maskableppo normalises advantages, which takes two: --n-steps times --n-envs and --batch-size must be "
            "at least 2, got 1 times 1 and 256.",
        ),
        (["--algo", "ppo", "--batch-size", "1"], "at least 2, got 128 times 8 and 1."),
        (["--env-kwargs", "map"], "--env-kwargs takes pairs name:value, got map"),
        (["--discovery.min-positive", "0"], "min_positive"),
        (["--option.max-duration", "0"], "max_duration"),
        (["--seed", "many"], "--seed"),
        (["--max-option", "3"], "--max-options"),
        (
            ["--algo=maskableppo", "--max-runs=5", "--discovery.segmentation=peaks"],
            "--max-runs counts in an episode, and a continuing task has none",
        ),
        (
            ["--algo", "ppo", "--learning-starts", "9"],
            "--learning-starts has no effect on ppo: it is a setting of dqn, qrdqn, optiondqn. Leave it out.",
        ),
        (
            ["dqn", "--n-epochs", "3"],
            "--n-epochs has no effect on dqn: it is a setting of ppo, recurrentppo, maskableppo. Leave it out.",
        ),
        (["--algo", "a2c", "--batch-size", "32"], "--batch-size has no effect on a2c"),
        (["--algo=trpo", "--ent-coef", "0.5"], "--ent-coef has no effect on trpo"),
        (["ppo", "--no-interruption"], "--interruption has no effect on ppo: it is a setting of dqn, qrdqn,"),
        (["--algo=ppo", "--max-option-exploration=1"], "--max-option-exploration has no effect on ppo"),
        (["--algo=ppo", "--max-runs=5"], "--max-runs has no effect on ppo: it is a setting of maskableppo."),
        (["--algo", "sarsa"], "There is no algorithm 'sarsa': choose from dqn, qrdqn,"),
        (["evaluat", "run"], "Did you mean 'evaluate'?"),
        (["sarsa"], "There is no algorithm 'sarsa': choose from dqn, qrdqn,"),
        (["ppo", "--seed", "1", "dqn"], "One algorithm is trained at a time: ppo or dqn?"),
        (["--seed", "1", "dqn", "--n-epochs", "3"], "--n-epochs has no effect on dqn"),
        (["--lr", "0.1"], "There is no flag --lr. Did you mean --learning-rate?"),
        (["ppo", "--total-timesteps=9"], "There is no flag --total-timesteps. Did you mean --n-timesteps?"),
        (["--n-timesteps", "1.5"], "a whole number is expected, such as 5000 or 5e3, not '1.5'"),
        (["--n-timesteps", "inf"], "a whole number is expected, such as 5000 or 5e3, not 'inf'"),
        (["--config"], "argument --config: expected one argument"),
        (["--help", "bags"], "invalid choice: 'bags' (choose from 'discovery', 'option', 'usefulness', 'all')"),
    ],
)
def test_what_makes_no_sense_is_refused(args: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert expected in refusal(capsys, args)


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (
            ["--env-kwargs", "gaol:[20, 0]", "max_steps:9"],
            "--env-kwargs: sb3_options/TwoRooms-v0 takes no 'gaol'. Did you mean 'goal'? It takes map, goal, starts,",
        ),
        (
            ["--env", "CartPole-v1", "--env-kwargs", "colour:red"],
            "--env-kwargs: CartPole-v1 takes no 'colour'. It takes sutton_barto_reward, render_mode.",
        ),
        (
            ["--env", "MiniGrid-DoorKey-5x5-v0", "--env-kwargs", "misson:False"],
            "--env-kwargs: MiniGrid-DoorKey-5x5-v0 takes no 'misson'. Did you mean 'mission'? It takes size,",
        ),
        (
            ["--env", "minigrid:MiniGrid-LockedRoom-v0", "--env-kwargs", "agent_view_sise:9"],
            "--env-kwargs: minigrid:MiniGrid-LockedRoom-v0 takes no 'agent_view_sise'. Did you mean 'agent_view_size'?",
        ),
        (
            ["--env", "MiniGrid-LockedRoom-v0", "--env-wrapper", "a:b", "--env-kwargs", "asked:False"],
            "--env-kwargs: MiniGrid-LockedRoom-v0 takes no 'asked'. It takes",
        ),
        (
            ["--env", "MiniGrid-MultiRoom-N2-S4-v0", "--env-kwargs", "env_id:MiniGrid-MultiRoom-N4-S5-v1"],
            "--env-kwargs takes arguments of --env MiniGrid-MultiRoom-N2-S4-v0, 'env_id' would name another",
        ),
        (
            ["--env-kwargs", "id:CartPole-v1"],
            "arguments of --env sb3_options/TwoRooms-v0, 'id' would name",
        ),
    ],
)
def test_keyword_arguments_that_the_environment_does_not_have(args: list[str], expected: str) -> None:
    with pytest.raises(ValueError, match=re.escape(expected)):
        parse(args)


def test_files_that_are_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "none.yml"
    said = f"train.py: --config {file} cannot be read: No such file or directory. Name another one."
    assert refusal(capsys, ["--config", str(file)]) == said


def test_a_run_folder_stands_for_its_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert refusal(capsys, ["--config", str(tmp_path)]) == (
        f"train.py: --config {tmp_path} is no run folder: it lacks config.yml. Name a file, or a run folder."
    )
    configs.save(PPOConfig(seed=7), tmp_path / "config.yml")
    assert parse(["--config", str(tmp_path)]) == PPOConfig(seed=7)


def test_an_environment_brings_its_own_defaults_and_files_and_flags_win_over_them(tmp_path: Path) -> None:
    pioneer, file = "sb3_options/PioneerCorner-v0", tmp_path / "config.yml"
    shipped = configs.tuned(pioneer)
    assert parse(["--env", pioneer]) == shipped
    assert parse(["--seed", "3", f"--env={pioneer}"]) == dataclasses.replace(shipped, seed=3)
    file.write_text(f"env: {pioneer}\ndiscovery:\n  scale: 3.0\n")
    from_file = parse(["--config", str(file), "--gamma", "0.5"])
    assert (from_file.env, from_file.gamma, from_file.discovery.scale) == (pioneer, 0.5, 3.0)
    assert from_file.n_timesteps == shipped.n_timesteps
    assert from_file.discovery.decay == shipped.discovery.decay
    assert parse(["--config", str(file), "--env", "CartPole-v1"]).n_timesteps == TrainConfig.n_timesteps


def test_an_algorithm_brings_its_own_defaults(tmp_path: Path) -> None:
    ppo = parse(["--algo", "ppo"])
    assert parse(["ppo"]) == parse(["--algo=ppo"]) == ppo
    assert isinstance(ppo, PPOConfig)
    assert (ppo.algo, ppo.n_envs, ppo.batch_size, ppo.learning_rate) == ("ppo", 8, 256, 1e-3)
    assert parse(["--algo", "ppo", "--n-envs", "2"]) == dataclasses.replace(ppo, n_envs=2)
    (tmp_path / "config.yml").write_text("algo: ppo\nn_steps: 64\n")
    from_file = parse(["--config", str(tmp_path / "config.yml"), "--gamma", "0.9"])
    assert from_file == dataclasses.replace(ppo, n_steps=64, gamma=0.9)


CHANGED = "algo: ppo\nlearning_rate: 0.0003\nn_steps: 64\nn_envs: 4\ngamma: 0.9\nnet_arch: [8]\n"


def test_a_file_for_another_algorithm_says_what_all_share(tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    path.write_text(CHANGED)
    assert parse(["--config", str(path), "--algo", "a2c"]) == A2CConfig(gamma=0.9, net_arch=(8,))
    assert parse(["dqn", "--config", str(path), "--n-steps=3"]) == DQNConfig(n_steps=3, gamma=0.9, net_arch=(8,))


@pytest.mark.parametrize(
    "args",
    [
        ["--seed", "1", "dqn"],
        ["--seed=1", "dqn"],
        ["--compare", "dqn", "--no-compare", "--seed", "1"],
        ["--discovery.no-equal-time", "DQN", "--discovery.equal-time", "--seed", "1"],
        ["--net-arch", "64", "64", "dqn", "--seed", "1"],
        ["dqn", "--seed", "1"],
        ["--algo", "DQN", "--seed", "1"],
    ],
)
def test_the_algorithm_stands_anywhere_in_any_case(args: list[str]) -> None:
    assert parse(args) == DQNConfig(seed=1)


def test_a_value_that_is_called_like_an_algorithm() -> None:
    config = parse(["--tensorboard-log", "ppo", "--options", "dqn", "a2c"])
    assert (config.algo, config.tensorboard_log, config.options) == ("a2c", Path("ppo"), Path("dqn"))


def test_whole_numbers_may_have_exponents() -> None:
    config = parse(
        ["--n-timesteps", "1e4", "--net-arch=3e1", "--max-new-options", "None", "--discovery.capacity=1.5e2"]
    )
    assert (config.n_timesteps, config.net_arch, config.discovery.capacity) == (10_000, (30,), 150)
    assert config.max_new_options is None


def test_what_gymnasium_takes_for_itself_is_no_mistake() -> None:
    for env_id in ("CartPole-v1", "MiniGrid-Empty-5x5-v0", "no/Such-v0"):
        assert parse(["--env", env_id, "--env-kwargs", "max_episode_steps:9"]).env_kwargs == {"max_episode_steps": 9}
    taken = ["mission:false", "asked:false", "size:6", "max_steps:50", "agent_view_size:5", "max_episode_steps:9"]
    for env_id in ("MiniGrid-Empty-5x5-v0", "minigrid:MiniGrid-Empty-5x5-v0"):
        assert len(parse(["--env", env_id, "--env-kwargs", *taken]).env_kwargs) == len(taken)


@pytest.mark.parametrize("algo", CLASSES)
def test_every_algorithm_has_valid_defaults_for_every_environment(algo: str) -> None:
    for env_id in (*shipped.TUNED, TrainConfig.env):
        config = parse(["--algo", algo, "--env", env_id])
        assert (config.algo, config.env) == (algo, env_id)
        assert config.discovery == configs.tuned(env_id).discovery


@pytest.mark.parametrize("words", [["--method", "l-cut"], ["--method=l-cut"], ["--discovery.method", "l-cut"]])
def test_the_method_of_discovery(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expected = parse(words)
    assert expected.discovery.method == "l-cut"
    path = tmp_path / "config.yml"
    for text in ("algo: maskableppo\nmethod: l-cut\n", "algo: maskableppo\ndiscovery:\n  method: l-cut\n"):
        path.write_text(text)
        assert parse(["--config", str(path)]) == expected
        assert parse(["--config", str(path), "--method", "random"]).discovery.method == "random"
    path.write_text("method: l-cut\ndiscovery:\n  method: random\n")
    assert "method is short for discovery.method: give one of them" in refusal(capsys, ["--config", str(path)])
    assert "random" in refusal(capsys, ["--method", "hand"])  # what there is


class TestHelp:
    def text(self, capsys: pytest.CaptureFixture[str], *args: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            parse([*args])
        assert stopped.value.code == 0
        return capsys.readouterr().out

    def flags(self, text: str) -> set[str]:
        return {word.strip(",") for word in text.split() if word.startswith("--")}

    def test_fits_a_screen_and_a_half(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("COLUMNS", "80")
        for algo in CLASSES:
            lines = self.text(capsys, algo, "--help").splitlines()
            assert max(map(len, lines)) <= 80
            assert len(lines) <= 75

    @pytest.mark.parametrize("algo", CLASSES)
    def test_shows_the_settings_of_the_algorithm(self, algo: str, capsys: pytest.CaptureFixture[str]) -> None:
        default = parse([algo])
        shown = self.flags(self.text(capsys, algo, "--help"))
        everything = self.flags(self.text(capsys, "--help", "all", "--algo", algo))
        for field in dataclasses.fields(default):
            flag = f"--{field.name.replace('_', '-')}"
            if field.name in GROUPS:
                group = {f"{flag}.{f.name.replace('_', '-')}" for f in dataclasses.fields(getattr(default, field.name))}
                assert not group & shown
                assert group <= everything
                assert group <= self.flags(self.text(capsys, algo, "-h", field.name))
            elif field.name != "algo":
                assert flag in shown & everything
        others = {f.name for of in CLASSES.values() for f in dataclasses.fields(of)} - {
            f.name for f in dataclasses.fields(default)
        }
        assert not {f"--{name.replace('_', '-')}" for name in others} & everything

    def test_shows_the_defaults_of_the_environment(self, capsys: pytest.CaptureFixture[str]) -> None:
        text = " ".join(self.text(capsys, "--env", "sb3_options/Pioneer-v0", "--help").replace("│", " ").split())
        assert "(default: sb3_options/Pioneer-v0)" in text
        assert "Primitive steps of all environments. (default: 30000)" in text
