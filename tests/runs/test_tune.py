import io
import math
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import optuna
import pytest
import yaml
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from rich.console import Console

from sb3_options.runs import config as configs
from sb3_options.runs import tune
from sb3_options.runs.commands import TuneConfig
from sb3_options.runs.compare import Goal
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.tune import read_space

BASE = {"algo": "ppo", "env": "CartPole-v1", "n_timesteps": 300, "n_envs": 1, "max_new_options": 0}
SEARCH: dict[str, Any] = {
    "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "n_steps": [32, 64],
    "net_arch": [[8], [16, 16]],
    "discovery.decay": {"low": 0.5, "high": 0.9},
}


def written(folder: Path, search: Any = None, **base: Any) -> Path:
    path = folder / "space.yml"
    path.write_text(yaml.safe_dump({"base": BASE | base, "search": SEARCH if search is None else search}))
    return path


def short(folder: Path, **values: Any) -> TrainConfig:
    settings = {"n_steps": 64, "batch_size": 64, "tensorboard_log": str(folder)}
    return configs.build(BASE | settings | values, "here")


def quiet() -> Console:
    return Console(file=io.StringIO(), width=160)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[TrainConfig]:
    """The runs that were made, of which the learning rate alone says how good they are."""
    runs: list[TrainConfig] = []

    def score(run: TrainConfig, *_: object) -> float:
        runs.append(run)
        return abs(math.log(run.algo_kwargs["learning_rate"] / 1e-3)) + 0.01 * run.seed

    monkeypatch.setattr(tune, "score", score)
    return runs


def study_in(folder: Path) -> optuna.Study:
    storage = JournalStorage(JournalFileBackend(str(folder / tune.JOURNAL)))
    return optuna.load_study(study_name="settings", storage=storage)


def test_a_space_is_read(tmp_path: Path) -> None:
    space = read_space(written(tmp_path), {})
    assert space.search == {
        "learning_rate": FloatDistribution(1e-4, 1e-2, log=True),
        "n_steps": CategoricalDistribution(["32", "64"]),
        "net_arch": CategoricalDistribution(["[8]", "[16, 16]"]),
        "discovery.decay": FloatDistribution(0.5, 0.9),
    }
    run = space.config({"n_steps": "64", "net_arch": "[16, 16]", "discovery.decay": 0.6}, 7, tmp_path)
    assert (run.seed, run.discovery.decay, run.tensorboard_log) == (7, 0.6, tmp_path)
    assert run.algo_kwargs["n_steps"] == 64
    assert run.algo_kwargs["policy_kwargs"] == {"net_arch": [16, 16]}


@pytest.mark.parametrize(
    ("search", "text"),
    [
        ({}, "write `base:` and `search:`"),
        ({"learning_rat": [1, 2]}, "there is no setting 'learning_rat'. Did you mean 'learning_rate'"),
        ({"learning_rate": 1e-3}, r"learning_rate takes \{low: 0.0001, high: 0.01, log: true\} or a list"),
        ({"learning_rate": {"low": 0.1}}, "learning_rate takes"),
        ({"learning_rate": {"low": 0, "high": 0.1, "log": True}}, "learning_rate takes"),
        ({"gamma": {"low": 0.9, "high": 1.1}}, "gamma"),
        ({"seed": [0, 1]}, "seed cannot be varied"),
        ({"discovery.decai": [0.1, 0.2]}, "there is no setting 'discovery.decai'. Did you mean 'discovery.decay'"),
    ],
)
def test_a_space_that_is_wrong_is_refused(search: Any, text: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=text):
        read_space(written(tmp_path, search), {})


def test_a_file_imports_no_module(tmp_path: Path) -> None:
    path = written(tmp_path, env="evil:Env-v0")
    with pytest.raises(ValueError, match=r"would import a module\. If you trust it, pass --env evil:Env-v0"):
        read_space(path, {})
    assert read_space(path, {"env": "CartPole-v1"}).base["env"] == "CartPole-v1"


def test_the_best_is_found_and_kept(tmp_path: Path, trained: list[TrainConfig]) -> None:
    console = quiet()
    best = tune.tune(TuneConfig(written(tmp_path), tmp_path / "out", trials=20, seeds=2), console)
    assert len(trained) <= 40
    assert {run.seed for run in trained} == {0, 1}
    rates = [run.algo_kwargs["learning_rate"] for run in trained]
    assert best.algo_kwargs["learning_rate"] == min(rates, key=lambda rate: abs(math.log(rate / 1e-3)))
    assert configs.load(tmp_path / "out" / tune.BEST) == best


def test_a_search_goes_on(tmp_path: Path, trained: list[TrainConfig]) -> None:
    config = TuneConfig(written(tmp_path), tmp_path / "out", trials=3, seeds=1)
    tune.tune(config, quiet())
    tune.tune(config, quiet())
    assert len(trained) == 3, "there are three already"
    tune.tune(TuneConfig(config.space, config.out, trials=5, seeds=1), quiet())
    assert len({run.algo_kwargs["learning_rate"] for run in trained}) == 5, "and none is drawn again"
    with pytest.raises(ValueError, match=r"holds another search"):
        tune.tune(TuneConfig(config.space, config.out, trials=5, seeds=2), quiet())
    written(tmp_path, gamma=0.5)
    with pytest.raises(ValueError, match="holds another search"):
        tune.tune(config, quiet())


def test_a_trial_that_was_killed_is_tried_again(tmp_path: Path, trained: list[TrainConfig]) -> None:
    config = TuneConfig(written(tmp_path), tmp_path / "out", trials=2, seeds=1)
    tune.tune(config, quiet())
    study = study_in(config.out)
    killed = study.ask(dict(read_space(config.space, {}).search))
    tune.tune(TuneConfig(config.space, config.out, trials=3, seeds=1), quiet())
    assert trained[-1].algo_kwargs["learning_rate"] == killed.params["learning_rate"]
    states = [trial.state for trial in study_in(config.out).trials]
    assert states == [TrialState.COMPLETE, TrialState.COMPLETE, TrialState.FAIL, TrialState.COMPLETE]


def test_the_score_is_the_logarithm_of_the_steps_to_the_goal(tmp_path: Path) -> None:
    def score(reach: str) -> float:
        return tune.score(short(tmp_path / reach, n_timesteps=500, seed=0), Goal.parsed(reach))

    assert score("return=5") < math.log(250)
    assert score("return=490") == pytest.approx(math.log(500))


@pytest.mark.slow
def test_a_search_from_the_command_line(tmp_path: Path) -> None:
    """Two trials at a time, an interrupt in the middle, and the same command again."""
    space = written(tmp_path, {"learning_rate": [1e-3, 1e-2], "n_steps": [32, 64]})
    command = [sys.executable, "-m", "sb3_options", "tune", str(space), "--out", str(tmp_path / "out")]
    command += ["--trials", "3", "--seeds", "2", "--reach", "return=15", "--jobs", "2"]

    def heard() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # background jobs of a shell ignore it

    first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heard)
    while not list((tmp_path / "out").glob(f"runs/*/*/{tune.LOG}")):
        assert first.poll() is None
        time.sleep(0.1)
    first.send_signal(signal.SIGINT)
    _, said = first.communicate()
    assert first.returncode == 130, said
    assert "Interrupted" in said
    second = subprocess.run(command, capture_output=True, text=True, check=False)
    assert second.returncode == 0, second.stderr
    states = [trial.state for trial in study_in(tmp_path / "out").trials]
    assert states.count(TrialState.COMPLETE) in (3, 4), "both jobs may have begun the last one"
    assert TrialState.RUNNING not in states
