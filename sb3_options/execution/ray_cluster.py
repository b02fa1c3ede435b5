"""Ray: environments and trainings on many machines; the extra ``cluster``."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from sb3_options.extras import how_to_install

OBJECT_STORE = 200 * 2**20
"""Bytes of shared memory of a cluster that is started here. Ray's default is 30 % of the machine's memory; what
environments and studies send is small and passes it by, but for images."""

PATIENCE = 10.0
"""Seconds that a cluster has to answer. Ray itself would wait for minutes for one that is gone."""

ADDRESS = "RAY_ADDRESS"
"""Ray's own variable that names a cluster."""

HOW_TO_START = (
    "Start one by `ray start --head` on one machine, and by the command that this prints on each of the others."
)


def require_ray() -> ModuleType:
    """Ray, imported.

    Raises:
        ModuleNotFoundError: It is not installed; the text names the extra.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read on import; by default Ray reports to its makers
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # without it Ray warns that this will be so
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"Ray is not installed: {how_to_install('cluster')}, on every machine.", name=error.name
        ) from error
    return ray


def connect(address: str | None = None) -> Any:
    """Ray, connected to a cluster. Where this process is connected already, it stays so.

    Args:
        address: Of the cluster's head, ``HOST:PORT``. "auto" is the one that the variable ``RAY_ADDRESS`` names, else
            the one that was started last on this machine. None is the one that the variable names, else a new one of
            this machine alone, which ends with the process.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: There is no such cluster; the text says how to start one.
    """
    ray = require_ray()
    if ray.is_initialized():
        return ray
    found = _found(address)
    if found is None:
        ray.init(address="local", include_dashboard=False, object_store_memory=OBJECT_STORE)
        return ray
    try:
        if not found.startswith("ray://"):
            host, _, port = found.rpartition(":")
            socket.create_connection((host, int(port)), timeout=PATIENCE).close()
        ray.init(address=found)
    except (OSError, ValueError, RuntimeError) as error:
        raise ConnectionError(f"No Ray cluster answers at {found!r}: {error}. {HOW_TO_START}") from error
    return ray


def _found(address: str | None) -> str | None:
    """Where a cluster should be; None for a new one.

    Raises:
        ConnectionError: "auto" finds none.
    """
    if address not in (None, "auto"):
        return address
    if os.environ.get(ADDRESS) or address is None:
        return os.environ.get(ADDRESS) or None
    note = Path(os.environ.get("RAY_TMPDIR", "/tmp")) / "ray" / "ray_current_cluster"  # left by `ray start`
    if not note.is_file():
        raise ConnectionError(f"No Ray cluster was started on this machine, and {ADDRESS} names none. {HOW_TO_START}")
    return note.read_text(encoding="utf-8").strip()


def n_cores(ray: Any) -> int:
    """Cores of all machines of a cluster, at least 1."""
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def emptiest(ray: Any, taken: Sequence[str | None], avoid: str | None = None) -> str | None:
    """The machine with the fewest actors for its cores.

    Ray's own "SPREAD" may put all of a few actors on one machine.

    Args:
        ray: Connected.
        taken: Machine of each actor that there is, by the id of its node.
        avoid: A machine to use only where there is no other.

    Returns:
        The id of its node; None where no machine has cores to give, so that Ray has to find a place.
    """
    cores = {node["NodeID"]: node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]}
    those = [name for name, n in cores.items() if n > 0 and name != avoid] or [name for name in cores if name == avoid]
    return min(those, key=lambda name: taken.count(name) / max(1.0, cores[name]), default=None)
