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
