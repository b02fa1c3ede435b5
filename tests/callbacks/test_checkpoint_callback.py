"""When `CheckpointCallback` writes a checkpoint, ends training at one, and refuses to make one."""

from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

from experiments.kills.states import differing
from sb3_options.callbacks import CheckpointCallback, EndedAtCheckpointError
from sb3_options.checkpoints.file import CheckpointFolder, read
from sb3_options.density.regions import Region
from sb3_options.discovery.methods import Experience
from tests.callbacks.test_checkpoint_resuming import discovering, model_of, trained, venv_of


class TestCheckpointCallback:
    def test_writes_every_so_many_steps_and_at_the_start(self, tmp_path: Path) -> None:
        checkpoints = CheckpointCallback(tmp_path, 200)
        model_of("PPO", venv_of()).learn(600, [discovering(), checkpoints])
        assert [int(file.stem) for file in checkpoints.folder] == [512, 256]

    @pytest.mark.usefixtures("keep_all")
    def test_changes_nothing(self, tmp_path: Path) -> None:
        _, often = trained(lambda: model_of("DQN", venv_of()), [discovering(), CheckpointCallback(tmp_path / "1", 1)])
        _, once = trained(
            lambda: model_of("DQN", venv_of()), [discovering(), CheckpointCallback(tmp_path / "2", 10**9)]
        )
        assert differing(often, once) == []

    def test_goes_on_without_where_the_disk_is_full(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        checkpoints = CheckpointCallback(tmp_path, 10**9)

        def full(*_: Any, **__: Any) -> None:
            raise OSError("No space left on device")

        monkeypatch.setattr(checkpoints.folder, "save", full)
        model_of("PPO", venv_of()).learn(64, [discovering(), checkpoints])
        assert caplog.messages == ["No checkpoint could be written, training goes on: No space left on device"]

    @pytest.mark.parametrize("name", ["PPO", "DQN"])
    def test_ends_training_at_one_where_it_is_asked_to(self, name: str, tmp_path: Path) -> None:
        model, asked = model_of(name, venv_of()), [0]

        def when() -> bool:
            asked[0] += 1
            return asked[0] == 3

        discovery = discovering()
        with pytest.raises(EndedAtCheckpointError):
            model.learn(5_000, [discovery, CheckpointCallback(tmp_path, 10**9, end_when=when)])
        file, state = CheckpointFolder(tmp_path).newest()
        assert int(file.stem) == state["model"]["counters"]["num_timesteps"] == model.num_timesteps > 0
        assert discovery._ended

    def test_refuses_models_that_are_not_known(self, tmp_path: Path) -> None:
        class Own(PPO):
            pass

        for model in (SAC("MlpPolicy", "Pendulum-v1"), Own("MlpPolicy", venv_of())):
            with pytest.raises(
                ValueError, match=rf"^Checkpoints of {type(model).__name__} are not supported yet; those"
            ):
                model.learn(8, CheckpointCallback(tmp_path))

    def test_refuses_callbacks_that_do_not_tell(self, tmp_path: Path) -> None:
        class Counting(BaseCallback):
            def __init__(self) -> None:
                super().__init__()
                self.counted = 0

            def _on_step(self) -> bool:
                return True

        with pytest.raises(ValueError, match=r"^Checkpoints of Counting are not supported yet: give the callback get_"):
            model_of("PPO", venv_of()).learn(8, [discovering(), Counting(), CheckpointCallback(tmp_path)])
        assert not list(tmp_path.iterdir())


def test_refuses_a_method_that_does_not_tell(tmp_path: Path) -> None:
    class Silent:
        def update(self, experience: Experience) -> list[Region]:
            return []

    with pytest.raises(TypeError, match=r"^a Silent cannot be stored: make it a dataclass, or give it get_state\(\)"):
        model_of("PPO", venv_of()).learn(64, [discovering(method=Silent()), CheckpointCallback(tmp_path)])


class Rows(KVWriter):
    """What is logged, step by step."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        self.rows.append((step, key_values.get("rollout/ep_rew_mean")))

    def close(self) -> None:
        pass


@pytest.mark.usefixtures("keep_all")
def test_a_checkpoint_lies_where_a_resumed_training_logs_the_same_rollouts(tmp_path: Path) -> None:
    """SB3 counts log_interval from the start of learn."""

    def logged(resume: Path | None) -> list[tuple[int, Any]]:
        model, rows = model_of("A2C", venv_of(1)), Rows()
        model.set_logger(Logger(None, [rows]))
        callback = CheckpointCallback(tmp_path / str(resume), 1)
        if resume is not None:
            callback.resume_from(read(resume))
        model.learn(32 * 11, callback, log_interval=3)
        return rows.rows

    whole = logged(None)
    files = sorted((tmp_path / "None").glob("0*"))
    assert [int(file.stem) for file in files] == [0, 96, 192, 288]
    assert logged(files[1]) == [row for row in whole if row[0] > 96]
