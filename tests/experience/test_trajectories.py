import gc
import logging
import weakref
from dataclasses import replace

import numpy as np
import pytest

from sb3_options.discovery.discovery import Discovery
from sb3_options.experience.trajectories import TrajectoryDatabase
from sb3_options.state import state_of
from tests.support.helpers import line


def test_the_database_keeps_the_last_n() -> None:
    database = TrajectoryDatabase(3)
    trajectories = [line([i, i + 1]) for i in range(7)]
    for n, trajectory in enumerate(trajectories, start=1):
        database.add(trajectory)
        assert len(database) == min(n, 3)
    assert [id(t) for t in database] == [id(t) for t in trajectories[4:]]


def test_the_database_counts_successes() -> None:
    database, again = TrajectoryDatabase(3), TrajectoryDatabase(3)
    for success in (True, False, True, True, False, False):
        database.add(replace(line([0, 1]), success=success))
        again.set_state(state_of(database))
        assert database.n_successful == again.n_successful == sum(each.success for each in database)


def test_the_database_counts_bytes(caplog: pytest.LogCaptureFixture) -> None:
    one = line(range(100))
    arrays = (one.trajectory.states, one.trajectory.visits, one.trajectory.actions, one.trajectory.rewards)
    assert one.n_bytes == sum(np.asarray(array).nbytes for array in arrays) + one.features.nbytes
    database = TrajectoryDatabase(10**30, max_bytes=3 * one.n_bytes)
    trajectories = [line(range(100)) for _ in range(7)]
    with caplog.at_level(logging.WARNING):
        for trajectory in trajectories:
            database.add(trajectory)
    assert [id(t) for t in database] == [id(t) for t in trajectories[4:]]
    assert len(caplog.records) == 1
    assert caplog.records[0].getMessage().startswith("The last 3 trajectories take all of their memory, ")
    large = line(range(1_000))
    database.add(large)
    assert list(map(id, database)) == [id(large)]
    database.add(trajectories[0])
    assert list(map(id, database)) == [id(trajectories[0])], "the large one is the older"


def test_a_feature_map_that_returns_a_view_keeps_nothing_alive() -> None:
    one = line(range(10)).trajectory
    batch = np.zeros((10, 1_000))
    gone = weakref.ref(batch)
    discovery = Discovery()
    labelled = discovery.add(one, batch[:, :1])
    del batch
    gc.collect()
    assert gone() is None
    assert labelled.features.base is None
