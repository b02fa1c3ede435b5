"""A real Ray cluster of two nodes on one machine, of which one can be killed."""

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sb3_options.execution.ray_vec_env import RayVecEnv, require_ray

STORE = 80 * 2**20  # bytes of shared memory of a node; Ray asks for 75 MB at least
LIMIT = 300.0  # seconds after which something hangs, on however slow a machine

SOON: dict[str, int] = {
    "health_check_period_ms": 1_000,
    "health_check_timeout_ms": 5_000,
    "health_check_failure_threshold": 3,
}
"""A dead node is noticed sooner than in Ray's half minute, and a slow one is not taken for dead."""


class TwoNodes:
    """A head, which this process is connected to, and a second node that tests kill and add again."""

    def __init__(self) -> None:
        self.ray: Any = require_ray()
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 1, "object_store_memory": STORE, "include_dashboard": False, "_system_config": SOON}
        self.cluster: Any = Cluster(initialize_head=True, head_node_args=head)
        self.second: Any = None
        self.address: str = self.cluster.address
        self.ray.init(address=self.address, log_to_driver=False)

    def add_second(self) -> str:
        """Add the second node if it is not there; returns its id."""
        if self.second is None:
            self.second = self.cluster.add_node(num_cpus=1, object_store_memory=STORE)
            self.cluster.wait_for_nodes()
        return str(self.second.node_id)

    @property
    def raylet(self) -> int:
        """The process of the second node."""
        return int(self.second.all_processes["raylet"][0].process.pid)

    def workers(self) -> list[int]:
        """Processes that the raylet of the second node has started; they outlive it for a while."""
        return [int(pid) for pid in Path(f"/proc/{self.raylet}/task/{self.raylet}/children").read_text().split()]

    def kill_second(self) -> None:
        """Kill the second node with all that runs on it, as a power cut would."""
        workers = self.workers()
        self.cluster.remove_node(self.second, allow_graceful=False)
        send(signal.SIGKILL, workers)
        self.second = None

    @contextmanager
    def second_gets(self, number: signal.Signals, *, workers: bool) -> Iterator[None]:
        """The raylet of the second node gets a signal, with or without its workers. The node is killed in the end."""
        pids = self.workers()
        send(number, [self.raylet, *(pids if workers else [])])
        try:
            yield
        finally:
            send(signal.SIGKILL, [self.raylet, *pids])
            self.cluster.remove_node(self.second, allow_graceful=False)
            self.second = None

    def end(self) -> None:
        """End both."""
        self.ray.shutdown()
        self.cluster.shutdown()


@contextmanager
def two_nodes() -> Iterator[TwoNodes]:
    """A cluster, ended afterwards."""
    before = os.environ.pop("RAY_ADDRESS", None)
    os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # Ray itself sets "token", for good, where it started a cluster
    nodes = TwoNodes()
    try:
        yield nodes
    finally:
        nodes.end()
        if before is not None:
            os.environ["RAY_ADDRESS"] = before


def send(number: signal.Signals, pids: Sequence[int]) -> None:
    """Send a signal to processes that may have ended."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)


def nodes_of(venv: RayVecEnv) -> list[str]:
    """The node of each actor."""

    def where(_: Any) -> str:
        import ray

        return str(ray.get_runtime_context().get_node_id())

    return [str(node) for node in venv._ray.get([actor.__ray_call__.remote(where) for actor in venv._actors])]


def wait_until(happened: Callable[[], object]) -> None:
    """Wait for an event, which has to come."""
    deadline = time.monotonic() + LIMIT
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.05)
