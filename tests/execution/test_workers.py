"""How worker processes are watched, without any; tests/integration/test_workers.py has them."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, call

import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options.execution import workers
from sb3_options.execution.workers import WorkerLostError, end_workers, watch_workers, watched_workers
from tests.support.helpers import CountingEnv


class ForkProcess(MagicMock):
    """A process that was forked."""


class Workers(SimpleNamespace):
    """As much of ``SubprocVecEnv`` as is watched: processes that have ended, and broken pipes to them."""

    def __init__(self, env_fns: Any, exitcode: int | None = None, **kwargs: Any) -> None:
        broken: dict[str, Any] = {"send.side_effect": BrokenPipeError, "recv.side_effect": EOFError}
        alive = {"is_alive.return_value": exitcode is None}
        super().__init__(
            env_fns=env_fns, kwargs=kwargs, num_envs=len(env_fns), waiting=True, closed=False, unwrapped=self,
            processes=[ForkProcess(exitcode=exitcode, pid=7, **alive) for _ in env_fns],
            remotes=[MagicMock(**broken, **{"poll.return_value": False}) for _ in env_fns],
        )  # fmt: skip


@pytest.fixture(autouse=True)
def ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "SubprocVecEnv", Workers)
    monkeypatch.setattr(workers, "wait", lambda each: each[1:])  # the process has ended


@pytest.mark.parametrize("error", [EOFError(), ConnectionResetError()])
def test_a_worker_that_ends_before_there_is_an_environment(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "SubprocVecEnv", MagicMock(side_effect=error))
    with pytest.raises(WorkerLostError, match=r"^Environment 0 of 2 is gone: .* before the environment") as caught:
        watched_workers([CountingEnv] * 2)
    assert (caught.value.killed, caught.value.__cause__) == (False, error)


@pytest.mark.parametrize("use", [lambda pipe: pipe.send(0), lambda pipe: pipe.recv()])
@pytest.mark.parametrize(
    ("exitcode", "killed", "how"),
    [
        (None, False, "closed its pipe"),
        (-9, True, "was killed by SIGKILL, as happens where memory runs out"),
        (-15, True, "was killed by SIGTERM"),
        (0, False, "ended with exit code 0; if an error in the environment ended it, that stands above"),
        (3, False, "ended with exit code 3; if an error in the environment ended it, that stands above"),
    ],
)
def test_says_how_a_worker_ended_and_ends_the_others(use: Any, exitcode: int | None, killed: bool, how: str) -> None:
    venv: Any = Workers([CountingEnv] * 2, exitcode)
    pipes = venv.remotes
    watch_workers(venv)
    with pytest.raises(WorkerLostError) as caught:
        use(venv.remotes[1])
    what = f"Environment 1 of 2 is gone: its worker process (pid 7) {how}. The other workers have been ended too."
    assert (caught.value.what, caught.value.killed) == (what, killed)
    assert str(caught.value).startswith(f"{what} Make new environments")
    assert (venv.waiting, venv.closed, [pipe.close.call_count for pipe in pipes]) == (False, True, [1, 1])
    ended = [call.terminate(), call.join(1.0), call.is_alive()]
    ended += [call.kill(), call.join(1.0)] if exitcode is None else []
    assert [process.method_calls for process in venv.processes] == [ended, [call.join(1.0), *ended]]


def test_without_worker_processes_an_environment_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    venv: Any = DummyVecEnv([CountingEnv])
    monkeypatch.setattr(venv, "close", MagicMock())
    watch_workers(venv)
    end_workers(venv)
    venv.close.assert_called_once_with()
    assert (str(WorkerLostError("Gone.")), WorkerLostError("Gone.").killed) == ("Gone.", False)
