"""Interrupts end training where it can go on from, or between two steps; before the first step nothing is left."""

import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import DQN

from sb3_options import OptionBank, cli
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.execution.workers import WorkerLostError
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import training
from sb3_options.runs.training import SIGNALS, Interrupts
from tests.runs.conftest import Register
from tests.support import runs as support

AT_STEP = 60  # of training


def send(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Nothing that a test installs stays, and nothing is ignored from before, as SIGHUP is under nohup."""
    outside = {number: signal.getsignal(number) for number in SIGNALS}
    for number, handler in outside.items():
        if handler is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    assert {number: signal.getsignal(number) for number in SIGNALS} == before
    for number, handler in outside.items():
        signal.signal(number, handler)


def command_line(tmp_path: Path, *more: str) -> list[str]:
    return ["dqn", "--env", "Counted-v0", "--no-progress", "--tensorboard-log", str(tmp_path), *more]


def trained(tmp_path: Path, **kwargs: Any) -> Path:
    return support.trained(tmp_path, algo="dqn", env="Counted-v0", **kwargs)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_training_after_its_step(
    number: int, register: Register, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    register(lambda step: send(number) if step == AT_STEP else None)
    with pytest.raises(SystemExit) as stopped:
        cli.main(command_line(tmp_path, "--checkpoint-freq", "0"))
    assert stopped.value.code == 128 + number  # as shells say it
    (folder,) = tmp_path.glob("dqn/*")
    said = capfd.readouterr()
    assert f"Interrupted after {AT_STEP} primitive steps" in said.out
    assert str(folder) in said.out
    assert "Interrupted: training ends soon and is saved. Once more to end it at once." in said.err
    assert DQN.load(folder / "model.zip").num_timesteps == AT_STEP
    OptionBank(2, 4).load(folder / "options.safetensors")
    assert "Resume:" not in said.out


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_training_at_a_checkpoint(
    number: int, register: Register, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    register(lambda step: send(number) if step == AT_STEP + 1 else None)
    folder = trained(tmp_path)
    said = capfd.readouterr()
    ends = AT_STEP + 4  # train_freq
    assert f"Interrupted after {ends} primitive steps" in said.out
    assert re.search(rf"^Resume: .+ resume \S*{folder.name}$", said.out, re.MULTILINE)
    file, state = CheckpointFolder(folder / runs.CHECKPOINTS).newest()
    assert int(file.stem) == state["model"]["counters"]["num_timesteps"] == ends
    assert DQN.load(folder / "model.zip").num_timesteps == ends


def test_a_rollout_that_takes_too_long_is_not_waited_for(
    register: Register, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "PATIENCE", 0.2)
    register(lambda step: send() if step == AT_STEP else time.sleep(0.05 * (step > AT_STEP)))
    folder = trained(tmp_path, train_freq=50)
    said = capfd.readouterr().out
    assert 100 > DQN.load(folder / "model.zip").num_timesteps > AT_STEP
    assert "Resume: " in said


def test_code_that_takes_all_exceptions_does_not_take_it(register: Register, tmp_path: Path) -> None:
    """As ``copyreg`` does in what SB3's ``DummyVecEnv`` copies."""

    def swallow(step: int) -> None:
        try:
            if step == AT_STEP:
                send()
        except BaseException:
            pass

    register(swallow)
    assert DQN.load(trained(tmp_path) / "model.zip").num_timesteps == AT_STEP


def test_where_it_was_ignored_as_in_a_script_s_background(register: Register, tmp_path: Path) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        register(lambda step: send() if step == AT_STEP else None)
        assert DQN.load(trained(tmp_path) / "model.zip").num_timesteps == AT_STEP
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_second_one_does_not_wait_for_the_step(
    register: Register, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def twice(step: int) -> None:
        if step == AT_STEP:
            send()
            send()
            pytest.fail("went on")

    register(twice)
    folder = trained(tmp_path)
    assert f"Interrupted after {AT_STEP - 1} primitive steps" in capfd.readouterr().out
    assert DQN.load(folder / "model.zip").num_timesteps == AT_STEP - 1


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("finished", [True, False])
def test_while_saving_it_changes_nothing(
    number: int, *, finished: bool, register: Register, tmp_path: Path, capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    save = DQN.save

    def interrupted(self: DQN, path: Any, *args: Any, **kwargs: Any) -> None:
        send(number)
        save(self, path, *args, **kwargs)
        send(number)

    monkeypatch.setattr(DQN, "save", interrupted)
    register(lambda step: send() if step == AT_STEP and not finished else None)
    folder = trained(tmp_path, n_timesteps=2 * AT_STEP)
    said = capfd.readouterr()
    assert ("Finished after" if finished else "Interrupted after") in said.out
    assert DQN.load(folder / "model.zip").num_timesteps == (2 if finished else 1) * AT_STEP
    assert {path.name for path in folder.iterdir()} == {
        "config.yml", "model.zip", "options.safetensors", "subgoals.png", "monitor", "tensorboard_1",
        "checkpoints",
    }  # fmt: skip


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("where", ["save", "make_model", "SubgoalDiscoveryCallback"])
def test_before_the_first_step_nothing_is_left(
    where: str, times: int, register: Register, tmp_path: Path, capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    register(lambda step: pytest.fail("took a step"))
    module: Any = configs if where == "save" else training
    original = getattr(module, where)

    def interrupted(*args: Any, **kwargs: Any) -> Any:
        for _ in range(times):
            send()
        return original(*args, **kwargs)

    monkeypatch.setattr(module, where, interrupted)
    with pytest.raises(SystemExit) as stopped:
        cli.main(["--env", "Counted-v0", "--no-progress", "--tensorboard-log", str(tmp_path / "runs")])
    assert stopped.value.code == 130
    assert "Interrupted" in capfd.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_worker_that_the_signal_ended_as_well_is_no_error(
    register: Register, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def lost(step: int) -> None:
        if step == AT_STEP:
            send(signal.SIGTERM)
            raise WorkerLostError("Environment 0 of 1 is gone")

    register(lost)
    assert (trained(tmp_path) / "model.zip").is_file()
    assert f"Interrupted after {AT_STEP - 1} primitive steps" in capfd.readouterr().out


@pytest.mark.parametrize(("at", "kept"), [(1, False), (AT_STEP, True)])
def test_an_error_keeps_what_was_learned(at: int, *, kept: bool, register: Register, tmp_path: Path) -> None:
    def fail(step: int) -> None:
        if step == at:
            raise ValueError("the environment's own error")

    register(fail)
    with pytest.raises(ValueError, match="the environment's own error") as error:
        trained(tmp_path)
    notes = getattr(error.value, "__notes__", [])
    folders = list(tmp_path.glob("dqn/*"))
    assert len(notes) == len(folders) == kept
    for folder in folders:
        assert notes == [f"What was learned until then is kept in {folder}."]
        assert DQN.load(folder / "model.zip").num_timesteps == at - 1


def test_nothing_is_installed_outside_the_main_thread() -> None:
    found: list[Any] = []

    def look() -> None:
        with Interrupts() as interrupts:
            found.extend([signal.getsignal(number) for number in SIGNALS])
            found.append(interrupts.signal)

    before = [signal.getsignal(number) for number in SIGNALS]
    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert found == [*before, None]


def test_what_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupts() as interrupts:
            send(signal.SIGHUP)
            assert interrupts.signal is None
    finally:
        signal.signal(signal.SIGHUP, before)
