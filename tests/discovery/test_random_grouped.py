"""The control on groups of features."""

import dataclasses
import json

import numpy as np
import pytest

from sb3_options.checkpoints.tree import decode, encode
from sb3_options.density.groups import FeatureGroup
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods.grouped import RandomGrouped
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import Trajectory
from sb3_options.state import restore, state_of

NEAR, FAR = FeatureGroup("near", [0], present=[[0]]), FeatureGroup("far", [1], present=[[1]])
SETTINGS = DiscoverySettings(start_radius=0, goal_radius=0, min_positive=4, spacing=0.5, method="random")


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


def test_radii_count_in_the_scale_of_the_settings() -> None:
    """At 0.5 only what is two apart from the start is farther away than 0.75, and a subgoal has the scale."""
    scaled = dataclasses.replace(SETTINGS, scale=0.5, start_radius=0.75)
    drawn = set()
    for seed in range(20):
        discovery = Discovery(scaled, groups=(NEAR,), seed=seed)
        live(discovery, 20)
        drawn |= {float(found.centre[0]) for found in discovery.found}
        assert all(found.subgoal.scale.tolist() == [0.5] for found in discovery.found)
    assert drawn == {2.0, 3.0}


def test_it_goes_on_with_its_state() -> None:
    """The draws after a checkpoint are those without one."""
    whole, other = (Discovery(SETTINGS, groups=[NEAR, FAR], seed=seed) for seed in (3, 4))
    live(whole, 8)
    content, arrays = encode(state_of(whole))
    restore(other, decode(json.loads(json.dumps(content)), arrays))
    n = len(whole.found)
    for each in (whole, other):
        live(each, 12)
    assert [f.centre.tolist() for f in whole.found] == [f.centre.tolist() for f in other.found]
    assert len(whole.found) > n > 0


def test_it_says_when_filters_leave_nothing() -> None:
    discovery = Discovery(DiscoverySettings(**{**vars(SETTINGS), "goal_radius": 100.0}), groups=[NEAR, FAR])
    live(discovery, 12)
    assert discovery.why_nothing() == (
        "No subgoal was discovered: the filters leave no state of 6 successful trajectories."
    )
