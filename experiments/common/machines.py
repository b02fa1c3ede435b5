"""Where the parts of a study run: in processes of this machine, or on the machines of a Ray cluster."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from joblib import Parallel, delayed

import sb3_options.envs  # noqa: F401  # registers them, in worker processes too
from sb3_options.execution.ray_vec_env import connect

T = TypeVar("T")

RETRIES = 10
"""How often a call is tried again whose machine or process was lost. An error that it raises itself ends the study."""


@dataclass(frozen=True, kw_only=True)
class Machines:
    """The flags that say where a study runs.

    Attributes:
        jobs: Processes; by default one a core.
        cluster: Run on the Ray cluster at HOST:PORT, or "auto": the one that runs on this machine or that the variable
            RAY_ADDRESS names.
    """

    jobs: int | None = None
    cluster: str | None = None


def finished(calls: Sequence[Callable[[], T]], on: Machines) -> Iterator[tuple[int, T]]:
    """What calls return, each in a process with one torch thread, in the order in which they end.

    On a cluster a call is a task that takes one core, and runs again elsewhere where its machine is lost. What a call
    needs has to be there on every machine: the same code and packages, and a folder that all share where it reads or
    leaves files.

    Args:
        calls: Which.
        on: Where; at most ``on.jobs`` at a time.

    Yields:
        The index of a call, and what it returned.

    Raises:
        ModuleNotFoundError: ``on.cluster`` needs Ray, which is not installed.
        ConnectionError: There is no such cluster.
        RuntimeError: A call was lost time and again.
        Exception: What a call raises.
    """
    if on.cluster is not None:
        yield from _on_cluster(calls, on)
        return
    parallel = Parallel(n_jobs=on.jobs or os.cpu_count(), return_as="generator_unordered", batch_size=1)
    yield from parallel(delayed(_single_threaded)(i, call) for i, call in enumerate(calls))


def _on_cluster(calls: Sequence[Callable[[], T]], on: Machines) -> Iterator[tuple[int, T]]:
    ray: Any = connect(on.cluster)
    task = ray.remote(_single_threaded).options(num_cpus=1, max_retries=RETRIES, scheduling_strategy="SPREAD")
    waiting = list(enumerate(calls))[::-1]
    running: dict[Any, int] = {}
    try:
        while waiting or running:
            while waiting and (on.jobs is None or len(running) < on.jobs):
                i, call = waiting.pop()
                running[task.remote(i, call)] = i
            (done, *_), _ = ray.wait(list(running))
            try:
                i, result = ray.get(done)
            except ray.exceptions.RayTaskError as error:
                raise (error.cause if isinstance(error.cause, Exception) else error) from None
            except ray.exceptions.RayError as error:
                what = str(error).strip().splitlines()[0]
                raise RuntimeError(
                    f"A part of the study was lost {RETRIES + 1} times with its machine or process: {what} What is "
                    "finished is kept. The same command goes on; fewer --jobs leave each more memory."
                ) from error
            del running[done]
            yield i, result
    finally:
        for reference in running:
            ray.cancel(reference, force=True)


def _single_threaded(index: int, call: Callable[[], T]) -> tuple[int, T]:
    import torch

    torch.set_num_threads(1)
    try:
        return index, call()
    finally:
        gc.collect()  # a model and its callbacks refer to each other: hundreds of finished runs would stay
