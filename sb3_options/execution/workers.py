"""Worker processes of ``SubprocVecEnv`` that end unexpectedly."""

import signal
from collections.abc import Callable, Sequence
from multiprocessing import get_all_start_methods, set_forkserver_preload
from multiprocessing.connection import Connection, wait
from typing import Any, NoReturn

import gymnasium as gym
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

LIBRARIES = ["gymnasium", "stable_baselines3", "torch"]  # these take a process seconds to import
PATIENCE = 1.0  # seconds for a process to end by itself before it is killed


class WorkerLostError(RuntimeError):
    """A worker process has ended unexpectedly; the others were ended too.

    If a signal ``killed`` it, the same training may succeed another time.
    """

    def __init__(self, what: str, advice: str = "", *, killed: bool = False) -> None:
        super().__init__(f"{what} {advice}".strip())
        self.what = what
        self.killed = killed


def watched_workers(env_fns: Sequence[Callable[[], gym.Env[Any, Any]]], **kwargs: Any) -> SubprocVecEnv:
    """Return a ``SubprocVecEnv`` that is watched from the start; see `watch_workers`.

    If Python's fork server makes the workers, it imports the libraries once for all of them.
    """
    if "forkserver" in get_all_start_methods():
        set_forkserver_preload(LIBRARIES)  # no effect on a server that runs already
    try:
        venv = SubprocVecEnv(list(env_fns), **kwargs)
    except (EOFError, ConnectionError) as error:
        raise WorkerLostError(
            f"Environment 0 of {len(env_fns)} is gone: its worker process ended before the environment was made; if "
            "an error ended it, that stands above."
        ) from error
    watch_workers(venv)
    return venv


def watch_workers(venv: VecEnv) -> None:
    """Raise a `WorkerLostError` when a worker process is lost, saying which one, why and what to do.

    Without it SB3 raises a bare ``EOFError`` or ``BrokenPipeError``. It even waits for ever if workers were forked and
    hold one another's pipes open. An environment without worker processes stays as it is.
    """
    inner = venv.unwrapped
    if isinstance(inner, SubprocVecEnv) and inner.processes:  # a RayVecEnv has none
        inner.remotes = tuple(
            remote if isinstance(remote, _WatchedPipe) else _WatchedPipe(remote, inner, index)
            for index, remote in enumerate(inner.remotes)
        )


class _WatchedPipe:
    """The parent's end of the pipe to a worker, as far as ``SubprocVecEnv`` uses it."""

    def __init__(self, remote: Connection, venv: SubprocVecEnv, index: int) -> None:
        self._remote = remote
        self._venv = venv
        self._index = index
        process = venv.processes[index]
        # Forked workers inherit one another's pipes, so the loss of one closes none of them.
        self._sentinel: int | None = process.sentinel if type(process).__name__ == "ForkProcess" else None

    def send(self, message: Any) -> None:
        try:
            self._remote.send(message)
        except ConnectionError as error:
            self._lost(error)

    def recv(self) -> Any:
        try:
            # Messages that it sent before it ended must still be read.
            if self._sentinel is None or self._remote in wait([self._remote, self._sentinel]) or self._remote.poll():
                return self._remote.recv()
        except (EOFError, ConnectionError) as error:
            self._lost(error)
        self._lost(None)

    def close(self) -> None:
        self._remote.close()

    def _lost(self, error: Exception | None) -> NoReturn:
        process = self._venv.processes[self._index]
        process.join(PATIENCE)
        what = (
            f"Environment {self._index} of {self._venv.num_envs} is gone: its worker process (pid {process.pid}) "
            f"{_how_it_ended(process.exitcode)}. The other workers have been ended too."
        )
        end_workers(self._venv)
        advice = "Make new environments and train on, with fewer of them or a DummyVecEnv if memory was short."
        raise WorkerLostError(what, advice, killed=(process.exitcode or 0) < 0) from error


def _how_it_ended(exitcode: int | None) -> str:
    if exitcode is None:
        return "closed its pipe"
    if exitcode < 0:
        name = signal.Signals(-exitcode).name
        return f"was killed by {name}" + (", as happens where memory runs out" if name == "SIGKILL" else "")
    return f"ended with exit code {exitcode}; if an error in the environment ended it, that stands above"


def end_workers(venv: VecEnv) -> None:
    """Close an environment that may be within a step, when its own ``close`` would wait for ever."""
    inner = venv.unwrapped
    if not (isinstance(inner, SubprocVecEnv) and inner.processes):
        venv.close()
        return
    for process in inner.processes:
        process.terminate()
    for process in inner.processes:
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
            process.join(PATIENCE)
    for remote in inner.remotes:
        remote.close()
    inner.waiting, inner.closed = False, True
