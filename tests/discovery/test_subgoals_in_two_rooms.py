"""Random walks in two rooms lead discovery to the doorway."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.recording import TrajectoryRecorder
from sb3_options.experience.trajectories import Trajectory
from tests.discovery.lines import SEARCHES, peaks_of

DOORWAY = (10.0, 5.0)
N_WALKS = 40
Walks = list[list[tuple[Trajectory, FloatArray]]]


@pytest.fixture(scope="module")
def walks() -> Walks:
    """For each of 6 seeds the first 40 successful trajectories of a random walk, failures left out."""
    result = []
    for seed in range(6):
        env = gym.make("sb3_options/TwoRooms-v0")
        rng = np.random.default_rng(seed)
        features = env.get_wrapper_attr("concept_features")
        recorder, kept = TrajectoryRecorder(), list[tuple[Trajectory, FloatArray]]()
        observation, _ = env.reset(seed=seed)
        recorder.begin(observation)
        while len(kept) < N_WALKS:
            action = int(rng.integers(4))
            observation, reward, terminated, truncated, info = env.step(np.int64(action))
            recorder.record(action, float(reward), observation)
            if terminated or truncated:
                recorder.end(terminated=terminated, truncated=truncated, is_success=info["is_success"])
                trajectory = recorder.finished[-1]
                if trajectory.is_success:
                    kept.append((trajectory, features(trajectory.states)))
                observation, _ = env.reset()
                recorder.begin(observation)
        result.append(kept)
    return result


def distance(walks: list[tuple[Trajectory, FloatArray]], searches: int, **settings: Any) -> float:
    """How far from the doorway the subgoal is that the last of these searches finds, and no earlier one."""
    discovery = Discovery(DiscoverySettings(search_growth=0.0, **settings), kind="environment")
    for trajectory, features in walks:
        discovery.add(trajectory, features)
    *before, last = [discovery.search() for _ in range(searches)]
    assert before == [None] * (searches - 1)
    return math.inf if last is None else float(np.linalg.norm(last.points[0] - DOORWAY))


class TestTwoRooms:
    @pytest.mark.parametrize("search", SEARCHES)
    def test_random_walks_lead_to_the_doorway(self, walks: Walks, search: Any) -> None:
        assert sum(distance(of_seed, 2, search=search) <= 1.0 for of_seed in walks) >= 5  # 1 − λ² > 0.4

    @pytest.mark.parametrize(("noise", "searches"), [(0.0, 2), (0.2, 4)])
    def test_a_state_that_is_known_to_cut_needs_to_persist_for_less(
        self, walks: Walks, noise: float, searches: int
    ) -> None:
        """The doorway of positions that are seen again; where they never are, it persists as long as before."""
        rng = np.random.default_rng(0)
        noisy = [(each, features + rng.uniform(-noise, noise, features.shape)) for each, features in walks[0]]
        assert distance(noisy, searches) <= 1.0 + 2 * noise

    def test_one_seed_one_result(self, walks: Walks) -> None:
        results = []
        for _ in range(2):
            discovery = Discovery(DiscoverySettings(), kind="environment")
            for trajectory, features in walks[0][:25]:
                discovery.add(trajectory, features)
                discovery.search()
            results.append(
                [(f.subgoal.points.tolist(), f.log_density) for f in discovery.found]
                + [(c.point.tolist(), c.average) for c in peaks_of(discovery).tracker.concepts]
            )
        assert results[0] == results[1]
