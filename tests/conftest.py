import gc
import os
from collections.abc import Callable, Sequence

# Two cores, and small tensors: more threads are slower, and sums over several threads need not repeat bit for bit.
# Set before torch is imported, so that the process that only distributes the tests need not import it.
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from tests.support import processes

processes.share_libraries()

# How fast the machine is decides nothing.
settings.register_profile("any speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any speed")


def pytest_collection_finish() -> None:
    """What the libraries made on import is there to stay: garbage collection need not look at it, nor be frequent."""
    gc.freeze()
    gc.set_threshold(50_000)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """A command that ends in an error: its exit status, and the one line that it says on stderr."""
    from sb3_options import cli  # for a few tests only

    def run(*words: str, codes: Sequence[int] = (1,), one_line: bool = True) -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            cli.main([*words])
        said = capsys.readouterr().err
        assert stopped.value.code in codes, said
        assert not one_line or len(said.strip().splitlines()) == 1, said
        return said

    return run
