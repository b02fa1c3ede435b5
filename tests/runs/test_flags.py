"""From the words of a command line to a configuration, and the help."""

import dataclasses
from pathlib import Path

import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.cli import COMMANDS, main, parse
from sb3_options.runs import config as configs
from sb3_options.runs.config import ALGORITHMS, FIELDS, GROUPS, TrainConfig, configure
from tests.support.runs import Refused


def test_flags_win_over_the_file_wherever_they_stand(tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    path.write_text("algo: dqn\nseed: 3\nn-timesteps: 500\nbonus: rnd\ndiscovery:\n  capacity: 9\n  decay: 0.5\n")
    for args in (
        ["--config", str(path), "--seed", "4", "--discovery.decay", "0.25", "--bonus", "none"],
        ["--seed", "4", "--discovery.decay", "0.25", "--bonus", "none", f"--config={path}"],
        ["dqn", "--seed", "4", "--config", str(path), "--discovery.decay", "0.25", "--bonus", "none"],
    ):
        config = parse(args)
        assert (config.seed, config.n_timesteps, config.bonus) == (4, 500, "none")
        assert (config.discovery.capacity, config.discovery.decay) == (9, 0.25)
    assert parse([]) == configure() == TrainConfig(algo_kwargs=configure().algo_kwargs)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_saved_configuration_is_read_back(algo: str, tmp_path: Path) -> None:
    config = parse([algo, "--seed", "5", "--env-kwargs", "max_steps:7", "--options", "a/run", "--net-arch", "3"])
    assert (config.algo, config.seed, config.env_kwargs) == (algo, 5, {"max_steps": 7})
    assert config.algo_kwargs["policy_kwargs"]["net_arch"] == [3]
    configs.save(config, tmp_path / "config.yml")
    assert parse(["--config", str(tmp_path / "config.yml")]) == config
    assert parse(["--config", str(tmp_path)]) == config  # a run folder stands for its settings


def test_arguments_of_the_algorithm_are_flags_and_lines_of_a_file(tmp_path: Path) -> None:
    expected = configure(algo="ppo", n_steps=64, normalize_advantage=False, learning_rate=1e-4)
    (tmp_path / "config.yml").write_text("algo: ppo\nn-steps: 64\nnormalize_advantage: false\nlearning_rate: 1e-4\n")
    for words in (
        ["ppo", "--n-steps", "64", "--normalize-advantage=false", "--learning-rate", "1e-4"],
        ["--config", str(tmp_path / "config.yml")],
    ):
        assert parse(words) == expected
    assert expected.algo_kwargs["n_epochs"] == configure(algo="ppo").algo_kwargs["n_epochs"]
    with pytest.raises(ValueError, match=r"there is no setting 'n_step'\. Did you mean 'n_steps'"):
        parse(["ppo", "--n-step", "64"])


def test_keyword_arguments_of_the_environment(tmp_path: Path) -> None:
    config = parse(["--env-kwargs", 'map:"S#\\nSG"', "max_steps:7", "goal:[1, 1]", "p:0.5", "note:a:b"])
    assert config.env_kwargs == {"map": "S#\nSG", "max_steps": 7, "goal": [1, 1], "p": 0.5, "note": "a:b"}
    configs.save(config, tmp_path / "config.yml")
    assert configs.load(tmp_path / "config.yml") == config


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--n-timesteps", "0"], "n_timesteps should be greater than or equal to 1, got 0"),
        (["--env-kwargs", "map"], "pairs name:value, got map"),
        (["--discovery.min-positive", "0"], "min_positive"),
        (["--max-option", "3"], "Did you mean 'max_options'"),
        (["ppo", "--learning-starts", "9"], "there is no setting 'learning_starts'"),
        (
            ["--algo", "sarsa"],
            "There is no algorithm 'sarsa'. Options need discrete actions: choose from maskableppo, ppo,",
        ),
        (["evaluat", "--episodes", "3"], "Did you mean 'evaluate'?"),
        (["sac"], "trpo, recurrentppo, dqn, qrdqn, optiondqn."),  # a2c is not meant
        (["--seed"], "--seed takes a value"),
        (["ppo", "dqn"], "There is no algorithm 'ppo dqn'"),
        (["--config"], "--config takes a value"),
        (["--method", "hand"], "random"),  # what there is
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(args: list[str], expected: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]*$") as error:
        parse(args)
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["evaluate"], "evaluate: run is missing"),
        (["evaluate", "a", "--episode", "3"], "there is no setting 'episode'. Did you mean 'episodes'?"),
        (["evaluate", "a", "--episodes", "0"], "evaluate: episodes should be greater than or equal to 1, got 0"),
        (["options"], "options: file is missing"),
        (["demo", "maze"], "demo: task should be 'rooms', 'key' or 'minigrid', got 'maze'"),
        (["compare", "a", "--reach"], "--reach takes a value"),
        (["ppo", "--seed", "many"], "seed should be"),
    ],
)
def test_usage_errors_are_a_line_and_exit_status_2(words: list[str], expected: str, refused: Refused) -> None:
    said = refused(*words, codes=[2])
    assert said.startswith("Error: ")
    assert expected in said


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="No such file or directory"):
        parse(["--config", str(tmp_path / "none.yml")])
    with pytest.raises(FileNotFoundError, match=r"config\.yml"):
        parse(["--config", str(tmp_path)])


def test_an_environment_brings_its_own_defaults_and_files_and_flags_win_over_them(tmp_path: Path) -> None:
    pioneer = "sb3_options/PioneerCorner-v0"
    shipped = configure(env=pioneer)
    assert shipped.algo == "dqn"
    assert parse(["--env", pioneer]) == shipped
    assert parse(["--seed", "3", f"--env={pioneer}"]) == dataclasses.replace(shipped, seed=3)
    file = tmp_path / "config.yml"
    file.write_text(f"env: {pioneer}\ndiscovery:\n  scale: 3.0\n")
    from_file = parse(["--config", str(file), "--gamma", "0.5"])
    assert (from_file.env, from_file.gamma, from_file.discovery.scale) == (pioneer, 0.5, 3.0)
    assert from_file.n_timesteps == shipped.n_timesteps
    assert from_file.discovery.decay == shipped.discovery.decay
    assert parse(["--config", str(file), "--env", "CartPole-v1"]).n_timesteps == TrainConfig.n_timesteps


def test_a_file_for_another_algorithm_says_what_all_share(tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    path.write_text("algo: ppo\nlearning_rate: 0.0003\nn_steps: 64\nn_envs: 4\ngamma: 0.9\n")
    assert parse(["--config", str(path), "--algo", "a2c"]) == configure(algo="a2c", gamma=0.9)
    assert parse(["dqn", "--config", str(path), "--n-steps=3"]) == configure(algo="dqn", n_steps=3, gamma=0.9)


@pytest.mark.parametrize("args", [["DQN", "--seed", "1"], ["--algo", "DQN", "--seed", "1"], ["dqn", "--seed=1"]])
def test_the_algorithm_comes_first_in_any_case(args: list[str]) -> None:
    assert parse(args) == configure(algo="dqn", seed=1)


@pytest.mark.parametrize("words", ["--method random", "--method=random", "--discovery.method random"])
def test_the_method_of_discovery(words: str, tmp_path: Path) -> None:
    expected = parse(words.split())
    assert expected.discovery.method == "random"
    path = tmp_path / "config.yml"
    for text in ("method: random\n", "discovery:\n  method: random\n"):
        path.write_text(text)
        assert parse(["--config", str(path)]) == expected
        assert parse(["--config", str(path), "--method", "relative-novelty"]).discovery.method[:3] == "rel"


class TestHelp:
    def text(self, capsys: pytest.CaptureFixture[str], *args: str) -> str:
        with pytest.raises(SystemExit, match=r"^0$"):
            parse([*args])
        return capsys.readouterr().out

    def test_a_setting_takes_a_line(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("COLUMNS", "80")
        short, whole = (self.text(capsys, "dqn", "--help", *more).splitlines() for more in ([], ["all"]))
        assert max(map(len, short + whole)) <= 80
        assert len(short) <= 30  # a screen

    def test_all_shows_all(self, capsys: pytest.CaptureFixture[str]) -> None:
        def shown(section: str) -> set[str]:
            words = self.text(capsys, "--help", section).split()
            return {word.replace("--no-", "--").replace(".no-", ".") for word in words}

        own = {name for name in FIELDS if name not in ("algo", "algo_kwargs", *GROUPS)}
        assert {f"--{name.replace('_', '-')}" for name in own} <= shown("all")
        for group, of in GROUPS.items():
            assert {f"--{group}.{f.name.replace('_', '-')}" for f in dataclasses.fields(of)} <= shown(group)

    @pytest.mark.parametrize("command", COMMANDS)
    def test_a_command_shows_what_it_takes(self, command: str, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit, match=r"^0$"):
            main([command, "--help"])
        words = capsys.readouterr().out.replace("--no-", "--").split()
        assert {f"--{name.replace('_', '-')}" for name in COMMANDS[command][0].__dataclass_fields__} <= {*words}

    def test_shows_the_defaults_of_the_environment(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("COLUMNS", "120")
        assert "30000" in self.text(capsys, "--env", "sb3_options/Pioneer-v0", "--help")
        assert "needs" not in self.text(capsys, "--help", "discovery")
