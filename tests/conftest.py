import numpy as np
import pytest
import torch

from tests.support import processes

# Two cores, and small tensors: more threads are slower, and sums over several threads need not repeat bit for bit.
torch.set_num_threads(1)
processes.share_libraries()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
