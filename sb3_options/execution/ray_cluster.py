"""Ray: environments and trainings on many machines; the extra ``cluster``."""

from __future__ import annotations

import os
from types import ModuleType
from typing import Any

from sb3_options.extras import how_to_install

OBJECT_STORE = 200 * 2**20
"""Bytes of shared memory of a cluster that is started here. Ray's default is 30 % of the machine's memory; what
environments and studies send is small and passes it by, but for images."""


def require_ray() -> ModuleType:
    """Ray, imported."""
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
        address: As ``ray.init`` takes it: the cluster's head, ``HOST:PORT``, or "auto". None is the cluster that the
            variable ``RAY_ADDRESS`` names, else a new one of this machine alone, which ends with the process.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: There is no such cluster.
    """
    ray = require_ray()
    if ray.is_initialized():
        return ray
    address = address or os.environ.get("RAY_ADDRESS")
    if address is None:
        ray.init(address="local", include_dashboard=False, object_store_memory=OBJECT_STORE)
    else:
        ray.init(address=address)
    return ray
