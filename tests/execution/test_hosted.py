"""What an actor of `RayVecEnv` does, without Ray: what a worker of ``SubprocVecEnv`` does."""

from typing import Any

import numpy as np

from sb3_options.execution.ray_vec_env import HostedEnvironments
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import Corridor, make_optioned_rooms, optioned_rooms


def test_an_episode_that_ends_is_begun_anew() -> None:
    hosted = HostedEnvironments([lambda: Corridor("dict", limit=2)] * 2)
    ((space, _),), _ = hosted.answer([(0, "get_spaces", None)])
    hosted.answer([(0, "reset", (1, {})), (1, "reset", (2, {}))])
    for ends in (False, True):
        answers, _ = hosted.answer([(0, "step", 0), (1, "step", 1)])
        assert [done for _, _, done, _, _ in answers] == [ends, ends]
    infos = [info for _, _, _, info, _ in answers]
    assert [info["TimeLimit.truncated"] for info in infos] == [True, True]
    assert all(space.contains(info["terminal_observation"]) for info in infos)


def test_what_was_set_is_set_again() -> None:
    def call(name: str, *args: Any, **kwargs: Any) -> Any:
        return "env_method", (name, args, kwargs)

    lost = HostedEnvironments([make_optioned_rooms] * 2)
    _, changed = lost.answer([(1, *call("set_slots", options={2: steady_option()}, expect_empty=True))])
    assert set(changed) == {1}
    assert lost.answer([(0, "get_attr", "gamma"), (1, "get_attr", "gamma")]) == ([0.9, 0.9], {})  # nothing has changed
    lost.answer([(1, *call("set_slots", report_availability=True))])
    _, changed = lost.answer([(1, *call("set_slots", options={0: steady_option()}))])
    hosted = HostedEnvironments([make_optioned_rooms] * 2)
    assert hosted.begin([None, changed[1]], [3, 4], None) == []
    one, other = hosted.envs
    assert not one.slot_state.expect_empty
    assert other.slot_state.expect_empty
    assert other.slot_state.report_availability
    assert (one.bank.filled, other.bank.filled) == ((), (0, 2))
    draws = [[env.action_space.sample() for _ in range(20)] for env in hosted.envs]
    assert draws[0] != draws[1]


def test_what_is_said_of_a_lost_step() -> None:
    env = optioned_rooms()
    env.reset(seed=0)
    env.set_slots(report_availability=True)
    plain: dict[str, Any] = {"index": -1, "duration": 1, "discount": 0.9, "gamma": 0.9, "termination": "truncated"}
    seen = np.zeros(2, dtype=np.float32)
    assert env.lost_step(seen) == {"option": plain}
    assert env._primitive["termination"] == "primitive"
    ((_, reward, done, info, _),) = HostedEnvironments([CountingEnv]).begin([None], [1], [seen])
    assert (reward, done) == (0.0, True)
    assert info == {"TimeLimit.truncated": True, "terminal_observation": seen, "lost": True}
