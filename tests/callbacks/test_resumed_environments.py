"""Training goes on in the middle of an episode of any environment; where it cannot, it says so."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize, VecVideoRecorder

from sb3_options import OptionsWrapper
from sb3_options.callbacks import CheckpointCallback, SubgoalDiscoveryCallback
from sb3_options.checkpoints.environments import refusal
from sb3_options.discovery.methods.grouped import GroupedPeaks
from sb3_options.envs.minigrid import make as make_minigrid
from tests.callbacks.test_checkpoint_resuming import check_resumes, discovering, model_of, trained
from tests.execution.test_repeating import Growing
from tests.support.sb3_helpers import TAXI, make_optioned_rooms

GAMMA = 0.9

pytestmark = pytest.mark.usefixtures("keep_all")


def optioned(make: Callable[[], gym.Env[Any, Any]]) -> Callable[[], gym.Env[Any, Any]]:
    return lambda: OptionsWrapper(Monitor(make()), 2, gamma=GAMMA)


def vec(make: Callable[[], gym.Env[Any, Any]], n: int = 2, *, subproc: bool = False) -> VecEnv:
    return SubprocVecEnv([make] * n, start_method="fork") if subproc else DummyVecEnv([make] * n)


def taxi() -> gym.Env[Any, Any]:
    return gym.make(TAXI)


def door_key() -> gym.Env[Any, Any]:
    return make_minigrid("MiniGrid-DoorKey-5x5-v0", max_steps=50)


def pioneer() -> gym.Env[Any, Any]:
    pytest.importorskip("pybullet")
    return gym.make("sb3_options/Pioneer-v0", max_steps=30)


def empty() -> gym.Env[Any, Any]:
    return make_minigrid("MiniGrid-Empty-Random-5x5-v0")


def rooms() -> Any:
    return make_minigrid("MiniGrid-MultiRoom-N2-S4-v0")


@pytest.mark.parametrize(
    ("name", "make", "subproc"),
    [
        ("A2C", taxi, False),
        ("DQN", door_key, True),
        pytest.param("MaskablePPO", door_key, False, marks=pytest.mark.slow),
        pytest.param("PPO", pioneer, False, marks=pytest.mark.slow),
        pytest.param("OptionDQN", taxi, True, marks=pytest.mark.slow),
    ],
)
def test_environments_that_do_not_tell_their_state(
    name: str, make: Callable[[], gym.Env[Any, Any]], subproc: bool, tmp_path: Path
) -> None:
    steps = 300 if make is pioneer else 900
    check_resumes(
        lambda: model_of(name, vec(optioned(make), subproc=subproc)),
        lambda: [discovering()],
        tmp_path,
        cuts=(0.0, 0.6),
        steps=steps,
    )


def test_without_options(tmp_path: Path) -> None:
    """As SB3 makes the environment: it was reset before anything is noted of it."""
    check_resumes(lambda: A2C("MlpPolicy", "CartPole-v1", seed=0), list, tmp_path, cuts=(0.0, 0.7), steps=300)


SOON = {"start_radius": 0.5, "goal_radius": 0.5, "decay": 0.5}
GROUPED = SOON | {"min_positive": 4, "threshold": 0.5}
RARE = SOON | {"min_positive": 6, "salient_share": 0.9}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "settings"),
    [
        (empty, GROUPED),
        (rooms, RARE | {"negative_strength": 0.1}),
        (rooms, RARE | {"negative_strength": 0.0}),
    ],
)
def test_grouped_discovery(make: Callable[[], gym.Env[Any, Any]], settings: Any, tmp_path: Path) -> None:
    """The features of MiniGrid have groups: each makes a concept by itself.

    In the rooms it begins before the first successes: parts of failures stand for these, and what is rare goes on to
    be counted.
    """
    callbacks, _ = check_resumes(
        lambda: model_of("MaskablePPO", vec(optioned(make))),
        lambda: [SubgoalDiscoveryCallback(settings, {"grow": True}, max_new_options=2)],
        tmp_path,
        cuts=(0.0, 0.3, 0.6, 0.9),
        steps=2500,
    )
    (discovery, _) = callbacks
    assert isinstance(discovery, SubgoalDiscoveryCallback)
    assert discovery.discovery is not None
    assert isinstance(discovery.discovery.method, GroupedPeaks)
    assert discovery.discoveries
    assert make is empty or any(each.whole is not None for each in discovery.discovery.database)


def test_wrappers_above_options_in_workers(tmp_path: Path) -> None:
    """As ``make_vec_env`` puts them: a Monitor around everything."""

    forked = {"start_method": "fork"}

    def make() -> Any:
        return model_of(
            "A2C", make_vec_env(make_optioned_rooms, 2, 0, vec_env_cls=SubprocVecEnv, vec_env_kwargs=forked)
        )

    check_resumes(make, lambda: [discovering()], tmp_path, cuts=(0.5,), steps=900)


def test_a_new_episode_where_it_cannot_go_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Ending(Growing):
        def step(self, action: Any) -> Any:
            observation, reward, _, _, info = super().step(action)
            return observation, reward, False, bool(self.np_random.random() < 0.1), info

    def make() -> Any:
        return A2C("MlpPolicy", VecNormalize(vec(Ending)), seed=0)

    trained(make, [CheckpointCallback(tmp_path / "whole", 1)], steps=200)
    file = sorted((tmp_path / "whole").glob("0*"))[10]
    checkpoints = CheckpointCallback(tmp_path / "rest", 10**9)
    with caplog.at_level(logging.WARNING, "sb3_options"):
        model, _ = trained(make, [checkpoints], resume=file, steps=200)
    (said,) = caplog.messages
    assert "cannot go on (environment 0: it took another course the second time; environment 1" in said
    assert model.num_timesteps == 200


def test_episodes_that_end_with_the_resumption_are_in_no_record(tmp_path: Path) -> None:
    """What was recorded of an episode that cannot go on is forgotten."""

    def make() -> Any:
        return model_of("A2C", vec(optioned(lambda: gym.wrappers.TimeLimit(Growing(), 20)), 1))

    trained(make, [discovering(), CheckpointCallback(tmp_path / "whole", 1)], steps=96)
    file = next(each for each in sorted((tmp_path / "whole").glob("0*"), reverse=True))
    again = discovering()
    trained(make, [again, CheckpointCallback(tmp_path / "rest", 10**9)], resume=file, steps=300)
    assert {each.steps for each in again.history} == {20}


def test_what_is_still_refused(tmp_path: Path) -> None:
    rendered = vec(lambda: OptionsWrapper(gym.make("CartPole-v1", render_mode="rgb_array"), 2))
    recorder = VecVideoRecorder(rendered, str(tmp_path / "videos"), bool)
    assert str(refusal(recorder)).startswith("Checkpoints of VecVideoRecorder are not supported: ")
    recorder.close()
