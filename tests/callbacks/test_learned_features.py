"""A feature map that is learned while a model trains: options are found, move along, are saved, and go on."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options import OptionsWrapper, load_model
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.learned_features import LearnedFeatures
from sb3_options.discovery.discovery import Discovery
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.envs import GridWorld
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.learning.macro_q import MacroQ
from sb3_options.options.option import SubgoalOption
from tests.callbacks.doorway import discovered, model_of
from tests.callbacks.test_checkpoint_resuming import check_resumes
from tests.support.helpers import equal
from tests.support.sb3_helpers import DOORWAY, FAST_DISCOVERY, small_rooms

LEARNING = {"updates": 200, "batch_size": 128}
"""Enough for the distances of two small rooms."""


@pytest.fixture(autouse=True)
def _learned_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_options.embedding.learner.FIRST_TRAJECTORIES", 4)


NEARER = {**FAST_DISCOVERY, "goal_radius": 1.5}


def temporal_rooms(file: Path | None = None, **kwargs: Any) -> OptionsWrapper:
    return OptionsWrapper(small_rooms(**kwargs), 2, gamma=0.9, feature_map="temporal-distance", options_file=file)


def callback_with(discovery: Mapping[str, Any] | None = None, **kwargs: Any) -> SubgoalDiscoveryCallback:
    return SubgoalDiscoveryCallback({**NEARER, **(discovery or {})}, **{"concepts": {"embedding": LEARNING}, **kwargs})


def parts_of(callback: SubgoalDiscoveryCallback) -> tuple[Discovery, LearnedFeatures]:
    search, features = callback.discovery, callback._keeper.features
    assert search is not None
    assert features is not None
    return search, features


def places(env: OptionsWrapper, observations: Any) -> Any:
    world = env.unwrapped
    assert isinstance(world, GridWorld)
    return world.concept_features(np.asarray(observations))


def test_what_a_map_waits_for_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("sb3_options.embedding.learner", "sb3_options.callbacks.learned_features"):
        monkeypatch.setattr(f"{module}.FIRST_TRAJECTORIES", 10_000)
    env = temporal_rooms()
    callback = callback_with()
    assert callback.why_nothing() == "No training has started."
    model = model_of(env, learning_starts=10_000, buffer_size=200)
    model.learn(1_000, callback)
    n = parts_of(callback)[0].diary.n
    assert n >= 1
    assert (callback.why_nothing() or "").endswith(f"gradient steps; {n} have ended, 0 are done. Train for longer.")
    callback.max_new_options = 0
    assert callback.why_nothing() == "Discovery was switched off."


@pytest.mark.parametrize("observation", ["onehot", pytest.param("image", marks=pytest.mark.slow)])
def test_the_doorway_is_found_without_coordinates(observation: str) -> None:
    env = temporal_rooms(observation=observation)
    callback = callback_with(max_new_options=1, option_settings={"initiation_steps": 8, "grow": True})
    model_of(env, learning_starts=10_000, buffer_size=200).learn(4_000, callback)
    (found,) = callback.discoveries
    search, _ = parts_of(callback)
    place = places(env, search.found[0].observation)[0]
    assert np.abs(place - DOORWAY).sum() <= 1
    # It was learned on since, and everything moved along.
    phi = env.bank.feature_map
    assert isinstance(phi, LearnedMap)
    assert phi.learned > 1
    option = discovered(env.bank, found.slot)
    assert option.termination(search.found[0].observation) == [1.0]  # type: ignore[arg-type]  # it has one
    for labelled in search.database:
        np.testing.assert_allclose(labelled.features, phi(labelled.trajectory.states), atol=0.002)
    inside = option.initiation(np.concatenate([np.asarray(t.trajectory.states) for t in search.database]))
    assert 0.0 < inside.mean() < 0.9


def test_options_move_along() -> None:
    """Subgoal and initiation set hold the same observations before and after the map was learned on."""
    env = temporal_rooms()
    callback = callback_with(max_new_options=1)
    model = MacroQ(env, gamma=0.9, seed=0)
    model.learn(1_500, callback)
    (found,) = callback.discoveries
    before = discovered(env.bank, found.slot)
    search, features = parts_of(callback)
    states = np.unique(np.concatenate([np.asarray(t.trajectory.states) for t in search.database]), axis=0)
    centres = before.initiation_set.points
    own = [any((row == centres).all(axis=1)) for row in env.concept_features(states)]
    was_inside = before.initiation(states)
    features.learner.n_trajectories = 0  # so that it is due
    assert features.learn_if_due(search, callback._keeper.options)
    after = discovered(env.bank, found.slot)
    assert np.abs(after.subgoal.points - before.subgoal.points).max() > 0.01
    assert len(after.initiation_set.points) == len(centres)
    inside = after.initiation(states)
    assert (was_inside & inside)[own].sum() >= 0.9 * np.sum(own)
    assert after.option_policy is before.option_policy


def test_a_narrowed_initiation_set_keeps_its_observations() -> None:
    """Though their trajectories have left the database, as they do when it is full."""
    env = temporal_rooms()
    callback = callback_with(max_new_options=1)
    MacroQ(env, gamma=0.9, seed=0).learn(1_500, callback)
    (found,) = callback.discoveries
    option = discovered(env.bank, found.slot)
    search, features = parts_of(callback)
    points = option.initiation_set.points
    narrowed = dataclasses.replace(option.initiation_set, points=points[:-1])
    *_, last = search.database
    search.database._replace([])
    search.database.add(LabelledTrajectory(last.trajectory, last.features + 1000.0, last.success))
    features.remember(found.slot, dataclasses.replace(option, initiation_set=narrowed), search)
    _, observations, known = features._anchors[found.slot]
    assert np.array_equal(known, points[:-1])
    at = np.unique(env.concept_features(np.asarray(observations)), axis=0)
    np.testing.assert_allclose(at, np.unique(points[:-1], axis=0), atol=1e-5)


def test_a_file_holds_the_map(tmp_path: Path) -> None:
    env = temporal_rooms()
    callback = callback_with(max_new_options=1)
    callback.save_path = tmp_path / "options.safetensors"
    model = model_of(env, learning_starts=10_000, buffer_size=200)
    model.learn(1_500, callback)
    assert callback.discoveries
    model.save(tmp_path / "model.zip")
    states = np.eye(45, dtype=np.float32)
    for file in ("options.safetensors", "model.zip"):
        fresh = temporal_rooms(tmp_path / file)
        assert len(fresh.bank) == 1
    assert equal(fresh.concept_features(states), env.concept_features(states))
    np.testing.assert_array_equal(fresh.available(states), env.available(states))
    loaded = load_model(DQN, tmp_path / "model.zip", temporal_rooms())
    again = callback_with(max_new_options=0, option_settings={"grow": False})
    loaded.learn(600, again)
    assert parts_of(again)[1].map.fixed
    np.testing.assert_array_equal(again.bank.available(states), env.available(states))
    option = again.bank[0]
    assert isinstance(option, SubgoalOption)
    start = option.initiation_set.points[:1]
    fewer = dataclasses.replace(option.initiation_set, points=start)
    again._keeper.replace(0, dataclasses.replace(option, initiation_set=fewer))
    assert again.bank.available(states)[:, 4].sum() < env.available(states)[:, 4].sum()


@pytest.mark.usefixtures("keep_all")
def test_cut_and_resumed_is_never_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while a map is being learned."""
    monkeypatch.setattr("sb3_options.embedding.learner.PAUSE_SECONDS", 0.04)
    monkeypatch.setattr("sb3_options.embedding.learner.STEPS_BETWEEN", 1)
    brief = {**LEARNING, "updates": 40}
    callbacks, _ = check_resumes(
        lambda: model_of(DummyVecEnv([temporal_rooms])),
        lambda: [callback_with(concepts={"embedding": brief}, option_settings={"grow": True})],
        tmp_path,
        cuts=(0.35, 0.6),
        steps=1_500,
    )
    callback = callbacks[0]
    assert isinstance(callback, SubgoalDiscoveryCallback)
    assert callback.discoveries
    assert parts_of(callback)[1].map.learned > 1


@pytest.mark.parametrize(
    "kwargs",
    [
        {"option_settings": {"policy_input": "features"}},
        {"method": "random"},
        {"concepts": {"groups": [{"name": "one", "features": [0]}]}},
    ],
)
def test_what_needs_features_that_stay_is_refused(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"^A learned feature map moves .* pass OptionsWrapper\(feature_map=\.\.\.\)"):
        model_of(temporal_rooms()).learn(10, callback_with(**kwargs))
