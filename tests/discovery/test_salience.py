"""What is rarely come upon stands for success until enough trajectories have succeeded."""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import pytest

from sb3_options.density.groups import FeatureGroup
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.salience import LEAST_TRAJECTORIES, OutcomeDatabase, Salience
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.state import state_of
from tests.checkpoints.test_tree import there_and_back

# Features: door visible, door ahead, goal visible, noise.
DOOR = FeatureGroup("door", [0, 1], present=[[0]], scale=[10, 1])
GOAL = FeatureGroup("goal", [2], present=[[2]], scale=[10])
BOTH = FeatureGroup("both", [0, 1, 2], present=[[0], [2]], scale=[10, 1, 10])
ANYTHING = FeatureGroup("anything", [3])
GROUPS = (DOOR, GOAL, BOTH, ANYTHING)

NOTHING, FAR, NEAR, BEHIND = [0, 0, 0, 0], [1, 2, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0]


def lived(states: Sequence[Sequence[float]], success: bool = False) -> LabelledTrajectory:
    """A trajectory whose every state is another one, by its noise."""
    features = np.array(states, dtype=np.float64)
    features[:, 3] = np.arange(len(features))
    n = len(features) - 1
    whole = Trajectory(features, np.arange(n + 1), np.arange(n), -np.arange(n * 1.0), success, not success, success)
    return LabelledTrajectory(whole, features, success)


def usual() -> LabelledTrajectory:
    return lived([NOTHING, FAR, NEAR, FAR, NOTHING])


def rare() -> LabelledTrajectory:
    return lived([NOTHING, FAR, NEAR, BEHIND, NOTHING, BEHIND])


def success() -> LabelledTrajectory:
    return lived([NOTHING, FAR, NEAR, BEHIND], success=True)


def lives(n_usual: int, n_rare: int = 0, n_successes: int = 0) -> list[LabelledTrajectory]:
    kinds = [usual] * n_usual + [rare] * n_rare + [success] * n_successes
    return [kind() for kind in kinds]


Holder = TypeVar("Holder", Salience, OutcomeDatabase)


def filled(holder: Holder, trajectories: Sequence[LabelledTrajectory]) -> Holder:
    for each in trajectories:
        holder.add(each)
    return holder


def after(trajectories: Sequence[LabelledTrajectory], share: float = 0.5) -> Salience:
    return filled(Salience(GROUPS, share, 3), trajectories)


def empty(capacity: int = 100, share: float = 0.5) -> OutcomeDatabase:
    return OutcomeDatabase(capacity, np.inf, Salience(GROUPS, share, 3))


def test_a_failure_counts_as_a_success_up_to_what_is_rare() -> None:
    salience = after(lives(12, 4))
    part = salience.label(rare())
    assert part.success
    assert part.trajectory.visits.tolist() == [0, 1, 2, 3]
    assert part.features[:, :3].tolist() == [NOTHING[:3], FAR[:3], NEAR[:3], BEHIND[:3]]
    assert (len(part.trajectory.states), part.trajectory.actions.tolist()) == (4, [0, 1, 2])
    assert part.trajectory.rewards.tolist() == [0, -1, -2]
    assert (part.trajectory.terminated, part.trajectory.truncated, part.trajectory.is_success) == (False, True, None)
    assert part.whole is not None
    assert (len(part.whole.trajectory), part.n_bytes) == (5, part.whole.n_bytes)
    for same in (usual(), success(), lived([BEHIND, NOTHING, BEHIND])):
        assert salience.label(same) is same


def test_states_that_are_visited_again_keep_their_rows() -> None:
    """0, 1, 0, 2 (the goal), 1, 3: of the states there are three until the goal."""
    states = np.array([NOTHING, FAR, BEHIND, NEAR], dtype=np.float64)
    visits = np.array([0, 1, 0, 2, 1, 3])
    whole = Trajectory(states, visits, np.arange(5), np.zeros(5), False, True, False)
    part = after(lives(15, 1)).label(LabelledTrajectory(whole, states, False))
    assert (part.trajectory.visits.tolist(), len(part.features), len(part.trajectory.states)) == ([0, 1, 0, 2], 3, 3)


@pytest.mark.parametrize(
    ("n_usual", "n_rare", "share", "salient"),
    [
        (LEAST_TRAJECTORIES - 2, 1, 0.5, False),  # too few show nothing
        (LEAST_TRAJECTORIES - 1, 1, 0.5, True),
        (10, 10, 0.5, True),
        (10, 11, 0.5, False),  # most come upon it
        (LEAST_TRAJECTORIES, 0, 0.5, False),  # nobody did, so nobody tells the way
        (15, 5, 0.0, False),
    ],
)
def test_rare_is_what_few_of_many_come_upon(n_usual: int, n_rare: int, share: float, salient: bool) -> None:
    salience = after(lives(n_usual, n_rare), share)
    assert salience.label(rare()).success == salient
    assert not salience.label(usual()).success  # a door is nothing rare, nor is a pair, or what is always there


def test_with_enough_successes_nothing_is_rare_any_more() -> None:
    salience = after(lives(20, n_successes=2))
    assert salience.label(rare()).success
    assert salience.add(success())
    assert not salience.label(rare()).success
    assert not any(salience.add(rare()) for _ in range(50))


def test_the_database_labels_those_of_before_anew() -> None:
    early = rare()
    database = filled(empty(), [early, *lives(LEAST_TRAJECTORIES - 2)])
    assert (database.n_successful, database.n_entered) == (0, 0)
    database.add(usual())
    (part,) = (each for each in database if each.success)
    assert part.whole is early
    assert (len(database), database.n_entered) == (LEAST_TRAJECTORIES, 1)
    database.add(rare())
    assert (database.n_successful, database.n_entered) == (2, 2)
    filled(database, lives(0, n_successes=3))
    assert database.n_successful == 3
    assert all(each.whole is None for each in database)
    assert any(each is early for each in database)
    assert len(database) == LEAST_TRAJECTORIES + 4


def test_a_database_goes_on_with_its_state() -> None:
    database, other = filled(empty(), lives(20, 6)), empty()
    other.set_state(there_and_back(state_of(database)))
    assert sum(each.whole is not None for each in other) == 6
    for both in (database, other):
        filled(both, lives(0, 1, 1))
    assert [each.success for each in database] == [each.success for each in other]
    assert (database.n_successful, database.n_entered) == (other.n_successful, other.n_entered) == (8, 8)


def why_nothing(n_rare: int, n_successes: int, **settings: Any) -> str:
    """After 16 that came upon nothing rare."""
    how = {"min_positive": 4, "salient_share": 0.5, "start_radius": 0, "goal_radius": 0}
    discovery = Discovery(DiscoverySettings(**{**how, **settings}), groups=GROUPS[:2])
    for life in lives(16, n_rare, n_successes):
        discovery.add(life.trajectory, life.features)
    assert discovery.search() is None
    return discovery.why_nothing()


def test_why_nothing_counts_what_stands_for_successes() -> None:
    stand = "Failures that stand for successes (salient_share):"
    assert "1 of 19 episodes succeeded; a search needs 4" in why_nothing(2, 1)
    assert why_nothing(2, 1).endswith(f" {stand} 2.")
    assert stand not in why_nothing(0, 3)
    assert why_nothing(8, 0, start_radius=99.0).endswith(f" {stand} 8.")


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_subgoals_are_found_before_anything_succeeds(share: float, caplog: pytest.LogCaptureFixture) -> None:
    settings = DiscoverySettings(start_radius=0, goal_radius=0, decay=0.5, threshold=0.5, salient_share=share)
    discovery = Discovery(settings, groups=GROUPS[:2])
    rng = np.random.default_rng(0)
    for _ in range(80):
        states = [NOTHING, NOTHING] + ([FAR] if rng.random() < 0.7 else [])
        life = lived([*states, NEAR, BEHIND, NOTHING] if rng.random() < 0.3 else [*states, NOTHING])
        discovery.add(life.trajectory, life.features, success=False)
        discovery.search()
    found = [(each.subgoal.group, each.centre.tolist()) for each in discovery.found]
    assert found[:1] == ([(DOOR, [1, 1])] if share else [])
    assert discovery.diary.successes == 0
    assert ("Discovery waits for a success" in caplog.text) == (share == 0)


def test_trajectories_that_are_labelled_anew_stay_in_the_order_in_which_they_came() -> None:
    """Else the failures that are kept would be those that came upon something rare."""
    every = [rare() if i in (0, 20) else usual() for i in range(40)] + lives(0, n_successes=3)
    database = filled(empty(10, 0.2), every[:30])
    other = empty(10, 0.2)
    other.set_state(there_and_back(state_of(database)))  # a checkpoint lies between
    for both in (database, other):
        filled(both, every[30:])
    failures = [each for each in database if not each.success]
    number = {id(each): i for i, each in enumerate(every)}
    assert [number[id(each)] for each in failures] == list(range(30, 40))
    kept = [each for each in other if not each.success]
    assert len(kept) == 10
    assert all(one is other for one, other in zip(kept[-9:], failures[-9:], strict=True))
