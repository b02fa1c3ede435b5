"""``examples/envpool_options.py`` as a user runs it, but shorter, and its environments."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sb3_contrib import MaskablePPO

from sb3_options.envs.minigrid.cells import DEPTH
from tests.support import processes
from tests.support.documents import ROOT, SHORTER

pytest.importorskip("envpool", reason="EnvPool has wheels for Linux only")
EXAMPLE = ROOT / "examples" / "envpool_options.py"
MAX_STEPS = 40  # of two rooms


@pytest.mark.slow
def test_the_example_leaves_a_model(tmp_path: Path) -> None:
    shorter = tmp_path / EXAMPLE.name
    shorter.write_text(SHORTER.sub(r"\g<1>\g<3>\g<2>", EXAMPLE.read_text(encoding="utf-8")), encoding="utf-8")
    result = processes.python(str(shorter), cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert MaskablePPO.load(tmp_path / "envpool.zip", device="cpu").action_space.n == 7 + 4  # type: ignore[attr-defined]


def test_episodes_end_as_stable_baselines3_expects() -> None:
    pool: Any = runpy.run_path(str(EXAMPLE))["MiniGridPool"]("MiniGrid-MultiRoom-N2-S4-v0", 4, seed=3)
    pool.seed(3)
    observations = pool.reset()
    cells = observations.reshape(4, -1, DEPTH)
    assert pool.observation_space.contains(observations[0])
    assert (cells.sum(axis=2) == 3).all()  # object, colour and state
    random = np.random.default_rng(0)
    for step in range(1, MAX_STEPS + 1):
        observations, rewards, dones, infos = pool.step(random.integers(0, 3, size=4))
        assert [("terminal_observation" in info) for info in infos] == dones.tolist()
        assert not rewards[~dones].any()
        if step < MAX_STEPS:
            assert not any(info.get("TimeLimit.truncated") for info in infos)
    ended = [info for info, done in zip(infos, dones, strict=True) if done]
    assert ended
    assert all(info["TimeLimit.truncated"] and not info["is_success"] for info in ended)
    assert all(
        (info["terminal_observation"] != row).any() for info, row in zip(ended, observations[dones], strict=True)
    )
    pool.close()


def test_an_episode_that_succeeds_in_its_last_step_is_not_truncated() -> None:
    pool: Any = runpy.run_path(str(EXAMPLE))["MiniGridPool"]("MiniGrid-MultiRoom-N2-S4-v0", 64, seed=3)
    pool.reset()
    random = np.random.default_rng(0)
    succeeded = []
    for _ in range(10 * MAX_STEPS):
        _, rewards, _, infos = pool.step(random.choice([0, 1, 2, 5], size=64))  # 5 opens doors
        assert [bool(info.get("is_success")) for info in infos] == (rewards > 0).tolist()
        succeeded += [info for info in infos if info.get("is_success")]
    assert succeeded
    assert not any(info["TimeLimit.truncated"] for info in succeeded)
    pool.close()
