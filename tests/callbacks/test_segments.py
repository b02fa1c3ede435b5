"""Discovery in tasks that go on, from segments between peaks of reward."""

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from tests.callbacks.doorway import model_of
from tests.support.sb3_helpers import DOORWAY, FAST_DISCOVERY, optioned_rooms


def make_endless_rooms() -> OptionsWrapper:
    """What a worker process calls."""
    return optioned_rooms(continuing=True, max_steps=None)


PEAKS: dict[str, Any] = {
    **FAST_DISCOVERY,
    "start_radius": 3.0,  # a segment begins where the last one ended: at the goal
    "segmentation": "peaks",
    "max_segment": 400,
}


def test_finds_the_doorway_in_rooms_that_never_end(tmp_path: Path) -> None:
    """The log is written, too, though no episode ends."""
    env = SubprocVecEnv([make_endless_rooms] * 2, start_method="fork")
    callback = SubgoalDiscoveryCallback(PEAKS, max_new_options=1)
    model_of(env, seed=1, tensorboard_log=str(tmp_path)).learn(4000, callback=callback)
    env.close()
    (found,) = callback.discoveries
    assert np.abs(found.subgoal - DOORWAY).sum() <= 1
    assert 3 <= found.episode <= callback.episodes
    assert callback.discovery is not None
    assert all(len(t.trajectory) <= 400 for t in callback.discovery.database)

    scalars = EventAccumulator(str(tmp_path / "DQN_1"))
    scalars.Reload()
    steps = [event.step for event in scalars.Scalars("slots/filled")]
    assert len(steps) > 3
    assert steps == sorted(steps)
    assert scalars.Scalars("slots/filled")[-1].value == 1
