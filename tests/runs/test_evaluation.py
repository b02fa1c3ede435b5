import re
import shutil
from pathlib import Path

import pytest

from sb3_options import cli
from sb3_options.runs import evaluation
from sb3_options.runs import folder as runs
from sb3_options.runs.config import DQNConfig
from sb3_options.runs.evaluation import evaluate_run


def test_a_configuration_that_would_import_a_module_is_refused(tmp_path: Path) -> None:
    for name in (runs.MODEL, runs.OPTIONS):
        (tmp_path / name).touch()
    (tmp_path / runs.CONFIG).write_text("env: evil_module:Foo-v0\n")
    with pytest.raises(ValueError, match=r"names the environment 'evil_module:Foo-v0', which would import a module"):
        evaluate_run(tmp_path)


def test_an_episode_that_never_ends_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = DQNConfig(
        env_kwargs={"continuing": True, "max_steps": None}, n_timesteps=50, discover=False, progress=False,
        tensorboard_log=tmp_path, device="cpu",
    )  # fmt: skip
    run = cli.train(config)
    monkeypatch.setattr(evaluation, "LONGEST_EPISODE", 300)
    with pytest.raises(
        ValueError,
        match=r"^An episode has not ended after 300 primitive steps: only episodes .+ limit in .+config\.yml",
    ):
        evaluate_run(run, episodes=1)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    config = DQNConfig(n_timesteps=50, progress=False, device="cpu", tensorboard_log=folder)
    return cli.train(config)


def test_an_environment_with_other_spaces_is_named_with_them(run: Path) -> None:
    with pytest.raises(ValueError, match="Choose an environment with the same") as error:
        evaluate_run(run, env="CartPole-v1")
    said = str(error.value)
    assert "was trained in sb3_options/TwoRooms-v0, with observations Box(0.0, 1.0, (210,), float32) and 4 act" in said
    assert re.search(r"; CartPole-v1 has observations Box\(.+, \(4,\), float32\) and 2 actions\. Choose", said)


def test_weights_that_do_not_fit_are_named_in_one_line(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    settings = (copy / runs.CONFIG).read_text()
    (copy / runs.CONFIG).write_text(settings.replace("net_arch:\n- 64\n- 64", "net_arch: [3]"))
    with pytest.raises(ValueError, match=r"model\.zip is damaged, or does not fit \S+config\.yml: .+q_net") as error:
        evaluate_run(copy)
    assert "\n" not in str(error.value)


def test_a_run_that_was_cut_off_says_how_to_go_on(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    (copy / runs.MODEL).unlink()
    with pytest.raises(FileNotFoundError, match=r"has no model\.zip: its training was cut off, or has not en") as error:
        evaluate_run(copy)
    (note,) = error.value.__notes__
    assert note.startswith("Go on from its last checkpoint: ")
    _, _, shown = note.rpartition(" resume ")  # relative to where tests run, if that is near
    assert Path(shown).resolve() == copy.resolve()
    shutil.rmtree(copy / runs.CHECKPOINTS)
    with pytest.raises(FileNotFoundError) as error:
        evaluate_run(copy)
    assert error.value.__notes__ == ["There is no checkpoint to go on from: train anew."]


def test_a_folder_without_settings_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"is no run folder: it lacks config\.yml\."):
        evaluate_run(tmp_path)
