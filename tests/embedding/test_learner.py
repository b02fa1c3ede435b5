"""Learned spaces against the truth: shortest paths."""

import copy
import dataclasses
import time
from typing import Any

import networkx as nx
import numpy as np
import pytest
from scipy.stats import spearmanr

from sb3_options.embedding.encoders import ObservationForm
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.learner import FeatureLearner
from sb3_options.embedding.settings import EmbeddingSettings
from sb3_options.envs.gridworld.maps import FOUR_ROOMS, TWO_ROOMS
from sb3_options.experience.trajectories import Trajectory
from sb3_options.state import restore, state_of
from tests.embedding.truth import distances, learned, path_through, rank_correlation, rooms, walked
from tests.support.helpers import equal

N = 20
LINE = walked(nx.path_graph(N), 2, 6000)
EVERY = np.arange(N)
TABLE = ObservationForm("table", (N,))


def new(form: ObservationForm = TABLE, seed: int = 0, **settings: Any) -> FeatureLearner:
    return FeatureLearner(LearnedMap(form, seed), EmbeddingSettings(**settings), seed)


def test_distances_on_a_line_are_in_steps() -> None:
    away = distances(learned(LINE, updates=300).map(EVERY))
    assert rank_correlation(away, LINE.steps) > 0.97
    assert np.median(np.diagonal(away, 1)) == pytest.approx(1.0, abs=0.1)
    means = [np.diagonal(away, k).mean() for k in range(1, N)]
    assert means == sorted(means)
    assert means[-1] > N / 2


@pytest.mark.slow
@pytest.mark.parametrize("text", [TWO_ROOMS, FOUR_ROOMS], ids=["TwoRooms", "FourRooms"])
def test_rooms(text: str) -> None:
    walk = rooms(text)
    features = learned(walk, updates=1500).map(np.arange(len(walk.graph)))
    assert rank_correlation(distances(features), walk.steps) > 0.92


def test_one_seed_one_map() -> None:
    one, same, other = (learned(LINE, seed, updates=5).map(EVERY) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.1


def test_a_state_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also between the pauses of one learning."""
    monkeypatch.setattr("sb3_options.embedding.learner.PAUSE_SECONDS", 0.007)
    one, other = (new(seed=seed, updates=10) for seed in (0, 1))
    assert [one.learn(LINE.trajectories, 8, 1000 * i) for i in range(4)] == [False, False, True, False]
    restore(other, copy.deepcopy(state_of(one)))
    for each in (one, other):
        assert each.learn(LINE.trajectories, 16, 4000)
    assert equal(one.map.arrays(), other.map.arrays())
    assert one.n_trajectories == other.n_trajectories == 16
    assert one.map.learned == 2


def test_pictures_are_learned_for_less_than_a_second_in_a_thousand_steps() -> None:
    """The map stays as it is until the last gradient step."""
    pictures = np.random.default_rng(0).integers(0, 256, (600, 4, 84, 84), dtype=np.uint8)
    walk = dataclasses.replace(path_through(list(range(600))), states=pictures)
    learner = new(ObservationForm("image", (4, 84, 84)), updates=5)
    before = learner.map.arrays()
    began = time.process_time()
    assert not learner.learn([walk], 8, 200)
    assert time.process_time() - began < 10.0  # about 1, but for the tests beside this one
    assert learner.done == 3
    assert equal(learner.map.arrays(), before)
    assert [learner.is_due(8, steps) for steps in (200, 699, 700)] == [False, False, True]
    assert learner.learn([walk], 8, 700)
    assert not equal(learner.map.arrays(), before)


def test_due_at_first_and_at_every_doubling() -> None:
    learner = new(updates=1)
    assert [learner.is_due(n, 0) for n in (7, 8)] == [False, True]
    learner.learn(LINE.trajectories, 9, 0)
    assert [learner.is_due(n, 0) for n in (17, 18)] == [False, True]


def test_where_nothing_moves_nothing_can_be_learned() -> None:
    learner = new()
    assert not learner.learn([path_through([3, 3, 3])], 1, 0)
    assert (learner.done, learner.map.learned) == (0, 0)


def corridor(unit: float) -> list[Trajectory]:
    """Walks to and fro, seen as a place and a number in another unit that says nothing."""
    random, walks = np.random.default_rng(0), []
    for _ in range(8):
        at = np.clip(np.cumsum(random.choice([-1, 1], 200)) % 18, 0, 17)
        at = np.minimum(at, 18 - at)
        walk = path_through(at.tolist())
        places = np.asarray(walk.states)
        seen = np.stack([places, unit * ((3 * places) % 7)], axis=1).astype(np.float32)
        walks.append(dataclasses.replace(walk, states=seen))
    return walks


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e30])
def test_numbers_in_other_units_take_nothing_from_each_other(unit: float) -> None:
    learner, walks = new(ObservationForm("vector", (2,)), updates=200), corridor(unit)
    while not learner.learn(walks, 8, 0):
        pass  # between two pauses
    places = np.arange(10.0)
    made = learner.map(np.stack([places, unit * ((3 * places) % 7)], axis=1))
    far = np.linalg.norm(made - made[0], axis=1)
    assert spearmanr(far, places).statistic > 0.9


def test_observations_that_are_not_finite_have_no_place() -> None:
    made = LearnedMap(ObservationForm("vector", (2,)))(np.array([[0.0, 1.0], [np.inf, 1.0], [np.nan, 1.0], [0.0, 2.0]]))
    assert np.isfinite(made).all(axis=1).tolist() == [True, False, False, True]


def test_a_map_that_diverges_stays_as_it_was() -> None:
    learner = new(updates=20)
    learner.learn(LINE.trajectories, 8, 0)
    before = learner.map(EVERY)
    learner.settings = EmbeddingSettings(updates=20, learning_rate=1e30)
    with pytest.raises(ValueError, match=r"^the learned feature map diverged and stays as it was: try a lower learnin"):
        learner.learn(LINE.trajectories, 16, 0)
    assert np.array_equal(learner.map(EVERY), before)
    assert not learner.is_due(31, 0)
    learner.settings = EmbeddingSettings(updates=20)
    learner.learn(LINE.trajectories, 32, 0)
    assert np.isfinite(learner.map(EVERY)).all()
