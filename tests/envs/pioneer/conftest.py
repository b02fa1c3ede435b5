from collections.abc import Iterator

import pytest

from sb3_options.envs.pioneer.env import PioneerTask
from tests.envs.pioneer.simulators import CLASSES, SIMULATORS


@pytest.fixture(params=SIMULATORS)
def cls(request: pytest.FixtureRequest) -> type[PioneerTask]:
    return CLASSES[request.param]


@pytest.fixture
def env(cls: type[PioneerTask]) -> Iterator[PioneerTask]:
    env = cls(max_steps=None)
    yield env
    env.close()
