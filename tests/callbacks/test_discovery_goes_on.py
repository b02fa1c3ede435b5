"""Discovery goes on in a second training and in hard tasks, and options that are there change or are closed."""

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback, usefulness
from sb3_options.callbacks.usefulness import MIN_RUNS
from sb3_options.density.regions import Region
from sb3_options.envs import Direction
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning import heads
from tests.callbacks.doorway import STEPS, banks, discovered, model_of, to_the_doorway
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import env_of, fast_callback, optioned_rooms, small_rooms


class TestGoesOn:
    def test_when_learn_is_called_again(self) -> None:
        callback, model = fast_callback(), model_of()
        model.learn(STEPS, callback=callback)
        options, head = banks(env_of(model))[0].slots, heads.option_outputs(model.policy)[0][0].weight.clone()
        assert len(callback.discoveries) == 1
        model.learn(0, callback=callback, reset_num_timesteps=False)
        assert len(callback.discoveries) == 1
        assert torch.equal(head, heads.option_outputs(model.policy)[0][0].weight)
        assert [o.name for o in banks(env_of(model))[0].slots if o] == [o.name for o in options if o]
        model.learn(400, callback=callback, reset_num_timesteps=False)
        # SB3 only looks at the budget when a rollout of 16 decisions ends.
        assert model.num_timesteps >= STEPS + 400

    def test_with_a_new_callback_that_finds_the_next_one(self) -> None:
        model = model_of()
        model.learn(STEPS, callback=fast_callback())
        again = fast_callback()
        model.learn(STEPS, callback=again)
        assert 0 in again.bank.filled
        assert all(d.slot == 1 for d in again.discoveries)

    def test_with_hand_made_options_that_were_there_before(self) -> None:
        env = optioned_rooms()
        hand_made = steady_option(3, name="mine", max_duration=2)
        env.bank.add(hand_made, 1)
        callback, model = fast_callback(), model_of(env)
        evaluation = EvalCallback(Monitor(optioned_rooms()), eval_freq=100_000, verbose=0)
        model.learn(STEPS, callback=[callback, evaluation])
        assert callback.bank[1] is env.bank[1] is banks(evaluation.eval_env)[0][1] is hand_made
        assert [d.slot for d in callback.discoveries] == [0]

    def test_after_nan_observations(self, caplog: pytest.LogCaptureFixture) -> None:
        class Spoilt(gym.ObservationWrapper[Any, Any, Any]):
            seen = 0

            def observation(self, observation: Any) -> Any:
                self.seen += 1
                return observation * np.nan if 40 <= self.seen < 45 else observation

        env = OptionsWrapper(Spoilt(small_rooms(observation="xy")), gamma=0.9, feature_map=lambda o: np.asarray(o))
        callback, model = fast_callback(), model_of(env)
        with caplog.at_level(logging.WARNING, "sb3_options"):
            model.learn(STEPS, callback=callback)
        assert model.num_timesteps >= STEPS
        (said,) = caplog.messages
        assert said.startswith("No discovery after episode 1: ")
        assert "NaN" in said
        assert len(callback.discoveries) == 1

    @pytest.mark.parametrize("reward", [math.nan, math.inf])
    def test_rewards_that_are_not_finite_are_named(self, reward: float) -> None:
        env = OptionsWrapper(gym.wrappers.TransformReward(small_rooms(), lambda _: reward), gamma=0.9)
        callback, model = fast_callback(success="terminated"), model_of(env)
        model.learn(200, callback=callback)
        assert "rewards, features or observations that are NaN or infinite; OptionsW" in (callback.why_nothing() or "")
        assert not callback.discoveries


def test_an_option_whose_runs_go_on_for_ever_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    # After ten runs it is sure that none arrives, but not yet that most go in circles, for some leave I.
    monkeypatch.setattr(usefulness, "MIN_RUNS", 20)
    monkeypatch.setattr(usefulness, "RUNS_BETWEEN", 5)
    env = optioned_rooms()
    env.bank.add(to_the_doorway(Direction.RIGHT, (3, 2)))
    env.bank.add(to_the_doorway(Direction.LEFT, (0, 2)))
    callback = SubgoalDiscoveryCallback(option_settings={"grow": False}, max_new_options=0)
    model_of(env, seed=0).learn(6000, callback=callback)
    assert [(closed.slot, closed.why) for closed in callback.closed] == [(1, "goes in circles")]
    assert callback.bank.filled == env.bank.filled == (0,)


def test_an_option_that_no_success_needs_gives_its_slot_to_one_that_is_discovered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(usefulness, "MIN_SUCCESSES", 3)
    env = optioned_rooms(1)
    elsewhere = Region(np.full((1, 2), 99.0), np.ones(2), 0.5)
    option = to_the_doorway(Direction.LEFT, (3, 2))
    env.bank.add(replace(option, subgoal=elsewhere))
    callback = fast_callback(max_new_options=1, use={"max_option_exploration": 0.05})
    model_of(env, seed=0).learn(3 * STEPS, callback=callback)
    assert [(closed.slot, closed.why) for closed in callback.closed] == [(0, "is not needed")]
    assert [found.slot for found in callback.discoveries] == [0]
    assert callback.bank.filled == env.bank.filled == (0,)


def test_runs_of_a_closed_option_do_not_count_for_the_next_one_in_its_slot() -> None:
    """With a rollout buffer a closed option goes on until the rollout ends, after its statistics were forgotten."""
    callback = fast_callback(max_new_options=1)
    for _ in range(MIN_RUNS):
        run = OptionRun(0, 1, 0.9, 0.9, "max_duration", np.eye(45)[:1], inside=True)
        callback._keeper.useful.add(run, 0, success=None)
    model_of(seed=0).learn(2 * STEPS, callback=callback)
    assert [found.slot for found in callback.discoveries] == [0]
    assert not callback.closed


def test_an_option_from_a_file_grows_where_it_is_used(tmp_path: Path) -> None:
    env = optioned_rooms()
    env.bank.add(to_the_doorway(Direction.RIGHT, (3, 2)))
    env.bank.save(tmp_path / "options")
    env = OptionsWrapper(small_rooms(), 4, gamma=0.9, options_file=tmp_path / "options")
    callback = SubgoalDiscoveryCallback(max_new_options=0, option_settings={"grow": True, "value_function": "table"})
    model_of(env).learn(2 * STEPS, callback=callback)
    points = {tuple(point) for point in discovered(env.bank).initiation_set.points}
    assert (3, 2) in points
    assert len(points) > 5
