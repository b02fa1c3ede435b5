import pytest

from sb3_options.experience.trajectories import TrajectoryDatabase
from tests.support.helpers import line


def test_the_database_keeps_the_last_n() -> None:
    database = TrajectoryDatabase(3)
    trajectories = [line([i, i + 1]) for i in range(7)]
    for n, trajectory in enumerate(trajectories, start=1):
        database.add(trajectory)
        assert len(database) == min(n, 3)
    assert [id(t) for t in database] == [id(t) for t in trajectories[4:]]


@pytest.mark.parametrize("capacity", [0, -1])
def test_the_database_needs_room_for_one(capacity: int) -> None:
    with pytest.raises(ValueError, match=rf"^capacity must be at least 1 trajectory, got {capacity}\.$"):
        TrajectoryDatabase(capacity)
