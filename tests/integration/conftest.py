"""A cluster for the tests of a module."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from sb3_options.execution.ray_vec_env import RayVecEnv
    from tests.support.clusters import TwoNodes


@pytest.fixture(scope="module")
def nodes() -> Iterator["TwoNodes"]:
    from tests.support.clusters import two_nodes  # for a few tests only

    with two_nodes() as made:
        yield made


@pytest.fixture
def ray_envs(nodes: "TwoNodes") -> Iterator[list["RayVecEnv"]]:
    """Whatever a test puts in is ended after it."""
    made: list[RayVecEnv] = []
    yield made
    for venv in made:
        venv.close()
