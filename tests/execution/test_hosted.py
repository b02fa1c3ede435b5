"""What an actor of `RayVecEnv` does, without Ray: what a worker of ``SubprocVecEnv`` does."""

from typing import Any

import numpy as np

from sb3_options.execution.hosted import HostedEnvironments, Settings
from sb3_options.execution.ray_vec_env import ASKING
from sb3_options.execution.slots import OptionSlots
from sb3_options.execution.wrapper import OptionsWrapper
from tests.support.helpers import CountingEnv
from tests.support.sb3_helpers import Corridor, make_optioned_rooms, optioned_rooms


def test_an_episode_that_ends_is_begun_anew() -> None:
    hosted = HostedEnvironments([lambda: Corridor("dict", limit=2)] * 2)
    space, _ = hosted.make()
    assert hosted.make() == hosted.make()
    hosted.reset([1, 2], [{}, {}])
    for ends in (False, True):
        steps = hosted.step(np.array([0, 1]))
        assert steps.dones == [ends, ends]
    assert [info["TimeLimit.truncated"] for info in steps.infos] == [True, True]
    assert all(space.contains(info["terminal_observation"]) for info in steps.infos)
    assert steps.observations["place"].shape == (2, 2)


def test_the_latest_settings_are_set_again() -> None:
    settings = Settings()
    for method, *args in [("expect_empty", False), ("set_marks", 1), ("expect_empty", True)]:
        settings.note("env_method", (method, *args), {}, key=method)
    assert settings.calls == [
        ("env_method", ("set_marks", 1), {}),
        ("env_method", ("expect_empty", True), {}),
    ]
    settings = Settings()
    settings.note("env_method", ("expect_empty", True), {}, key="expect_empty")
    settings.note("set_attr", ("mark", [7]), {}, key="mark")
    hosted = HostedEnvironments([make_optioned_rooms] * 2)
    hosted.begin([settings, settings], [3, 4])
    one, other = hosted.envs
    assert one._expects_empty
    assert other._expects_empty
    assert one.mark == other.mark == [7]
    assert one.mark is not other.mark  # they share nothing
    draws = [[env.action_space.sample() for _ in range(20)] for env in hosted.envs]
    assert draws[0] != draws[1]


def test_every_asking_method_is_there() -> None:
    known = {name for name in dir(OptionsWrapper) if not name.startswith("_")} | {"__str__", "run_folder"}
    assert known >= ASKING
    changing = {name for name in vars(OptionSlots) if name.startswith(("set_", "report_", "record_", "load_"))}
    assert not (changing - {"set_state", "set_layer_states"}) & ASKING


def test_what_is_said_of_a_lost_step() -> None:
    env = optioned_rooms()
    env.reset(seed=0)
    env.report_availability(True)
    plain: dict[str, Any] = {"index": -1, "duration": 1, "discount": 0.9, "gamma": 0.9, "termination": "truncated"}
    seen = np.zeros(2, dtype=np.float32)
    assert env.lost_step(seen) == {"option": plain}
    assert env._primitive["termination"] == "primitive"
    hosted = HostedEnvironments([CountingEnv])
    hosted.make()
    assert hosted.lost_infos([seen]) == [{}]  # without options there is nothing to say
