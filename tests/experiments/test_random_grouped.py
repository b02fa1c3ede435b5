"""The control on groups of features."""

import numpy as np
import pytest

from experiments.minigrid.random_grouped import RandomGrouped
from sb3_options.density.groups import FeatureGroup
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import Trajectory

NEAR, FAR = FeatureGroup("near", [0], present=[[0]]), FeatureGroup("far", [1], present=[[1]])
SETTINGS = DiscoverySettings(start_radius=0, goal_radius=0, min_positive=4, spacing=0.5)


def live(discovery: Discovery, n: int) -> None:
    for i in range(n):
        success = i % 2 == 0
        moves = [[0, 0, 1], [1, 0, 1], [2, success, 1], [3, 2 * success, 1], [4, 0, 1]]
        states, t = np.array(moves, dtype=np.float64), len(moves) - 1
        made = Trajectory(states, np.arange(t + 1), np.zeros(t, int), np.zeros(t), True, False, success)
        discovery.add(made, states)
        discovery.search()


@pytest.mark.parametrize("contrasting", [False, True])
def test_random_subgoals_are_states_of_random_groups(contrasting: bool) -> None:
    drawn = []
    for seed in range(20):
        discovery = Discovery(SETTINGS, RandomGrouped(contrasting=contrasting, seed=seed), groups=(NEAR, FAR))
        live(discovery, 20)
        drawn.append([(found.subgoal.group, float(found.centre[0])) for found in discovery.found])
    everywhere = {(FAR, 1.0), (FAR, 2.0)} | (set() if contrasting else {(NEAR, 1.0), (NEAR, 2.0), (NEAR, 3.0)})
    assert {each for subgoals in drawn for each in subgoals} == everywhere
    assert all(len(set(subgoals)) == len(subgoals) == len(everywhere) for subgoals in drawn)
    assert len({subgoals[0] for subgoals in drawn}) == len(everywhere)
