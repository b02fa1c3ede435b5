"""`RayVecEnv` without a cluster: its actors are objects of this process."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_options.execution import ray_vec_env
from sb3_options.execution.ray_vec_env import HostedEnvironments, RayVecEnv
from sb3_options.execution.workers import PATIENCE
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import Corridor, make_optioned_rooms


class RayError(Exception):
    """What all errors of Ray are."""


class Actor:
    """An actor that can be lost."""

    def __init__(self, hosted: HostedEnvironments) -> None:
        self.hosted, self.lost = hosted, False
        self.answer = SimpleNamespace(remote=lambda messages: lambda: self._answer(messages))
        self.close = SimpleNamespace(remote=lambda: lambda: "closed")

    def _answer(self, messages: Any) -> Any:
        if self.lost:
            raise Ray.exceptions.RayActorError
        return self.hosted.answer(messages)


class Ray:
    """As much of Ray as `RayVecEnv` uses."""

    exceptions = SimpleNamespace(RayError=RayError, **{name: type(name, (RayError,), {}) for name in (
        "RayActorError", "NodeDiedError", "WorkerCrashedError", "ObjectLostError", "OutOfMemoryError",
        "GetTimeoutError", "RayTaskError",
    )})  # fmt: skip

    def remote(self, cls: Any) -> Any:
        make = SimpleNamespace(remote=lambda env_fns: Actor(cls(env_fns)))
        return SimpleNamespace(options=lambda **_: make)

    n_cores: float | None = 2.0

    def __init__(self) -> None:
        self.timeouts: list[float | None] = []
        self.waited: list[Any] = []
        self.is_initialized = lambda: True

    def cluster_resources(self) -> dict[str, float]:
        return {"GPU": 7.0} | ({} if self.n_cores is None else {"CPU": self.n_cores})

    def wait(self, references: Any, num_returns: int, timeout: float) -> None:
        self.waited.append(([reference() for reference in references], num_returns, timeout))

    def get(self, reference: Any, timeout: float | None) -> Any:
        self.timeouts.append(timeout)
        return reference()

    def kill(self, actor: Actor) -> None:
        actor.lost = True


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> Ray:
    ray = Ray()
    monkeypatch.setattr(ray_vec_env, "connect", lambda: ray)
    return ray


def test_an_episode_that_ends_is_begun_anew() -> None:
    hosted = HostedEnvironments([lambda: Corridor("dict", limit=2)] * 2)
    ((space, _),) = hosted.answer([(0, "get_spaces", None)])
    hosted.answer([(0, "reset", (1, {})), (1, "reset", (2, {}))])
    for ends in (False, True):
        answers = hosted.answer([(0, "step", 0), (1, "step", 1)])
        assert [done for _, _, done, _, _ in answers] == [ends, ends]
    infos = [info for _, _, _, info, _ in answers]
    assert [info["TimeLimit.truncated"] for info in infos] == [True, True]
    assert all(space.contains(info["terminal_observation"]) for info in infos)


def test_what_was_set_is_set_again_in_environments_that_start_anew(ray: Ray) -> None:
    venv = RayVecEnv([make_optioned_rooms] * 3, 2)
    venv.seed(3)
    seen: Any = venv.reset()
    venv.env_method("set_slots", options={2: steady_option()}, expect_empty=True, indices=1)
    venv.env_method("set_slots", report_availability=True)
    venv.env_method("set_option", 0, steady_option(), indices=1)
    ray.kill(venv._actors[0])
    one, other, not_lost = venv.get_attr("slot_state")
    assert [state.expect_empty for state in (one, other, not_lost)] == [False, True, False]
    assert all(state.report_availability for state in (one, other, not_lost))
    assert [bank.filled for bank in venv.get_attr("bank")] == [(), (0, 2), ()]
    result: Any = venv.step(np.zeros(3, dtype=np.int64))
    assert (result[1].tolist()[:2], result[2].tolist()) == ([0.0, 0.0], [True, True, False])
    for i, available in ((0, False), (1, True)):
        info = result[3][i]
        assert info["TimeLimit.truncated"] is True
        np.testing.assert_array_equal(info["terminal_observation"], seen[i])
        run = {"index": -1, "duration": 1, "discount": 0.9, "gamma": 0.9, "termination": "truncated"}
        assert {name: info["option"][name] for name in run} == run
        assert ("available" in info["option"]) is available
    assert venv.lost_actors == 1
    assert not venv.step(np.zeros(3, dtype=np.int64))[2].any()


def test_an_environment_without_options_is_lost(ray: Ray) -> None:
    venv = RayVecEnv([CountingEnv], 1)
    seen: Any = venv.reset()
    ray.kill(venv._actors[0])
    _, rewards, dones, infos = venv.step(np.array([0]))
    assert (rewards.tolist(), dones.tolist()) == ([0.0], [True])
    assert infos[0].pop("terminal_observation").tolist() == seen[0].tolist()
    assert infos[0] == {"TimeLimit.truncated": True, "lost": True}


@pytest.mark.parametrize(
    ("n_envs", "n_actors", "n_cores", "groups"),
    [
        (5, None, 2.0, [[0, 1, 2], [3, 4]]),
        (2, None, 8.0, [[0], [1]]),
        (2, None, 0.5, [[0, 1]]),
        (2, None, None, [[0, 1]]),
        (3, 2, 8.0, [[0, 1], [2]]),
        (2, 9, 1.0, [[0], [1]]),
    ],
)
def test_environments_are_shared_out_among_actors(
    ray: Ray, n_envs: int, n_actors: int | None, n_cores: float | None, groups: list[list[int]]
) -> None:
    ray.n_cores = n_cores
    venv = RayVecEnv([CountingEnv] * n_envs, n_actors)
    assert venv._groups == groups
    assert len(venv._actors) == len(groups)
    first, later = ray.timeouts[: len(groups)], ray.timeouts[len(groups) :]
    assert (venv.step_timeout, set(first)) == (600.0, {None})  # to make them may take as long as it takes
    assert later == pytest.approx([600.0] * len(later), abs=5.0)
    assert later


def test_seeds_after_losses_are_new_and_repeat(ray: Ray) -> None:
    """And where a lost environment is reset, no step tells of the loss."""
    venv = RayVecEnv([Corridor] * 2, 1, step_timeout=None)
    venv.seed(3)
    venv.reset()
    ray.kill(venv._actors[0])
    venv.get_attr("spec")
    venv.reset()
    assert (venv.lost_actors, venv._first_seeds) == (1, [3, 4])  # a reset without a seed keeps those of the first
    assert not any("lost" in info for info in venv.step(np.zeros(2, dtype=np.int64))[3])
    later = [int(np.random.SeedSequence([first, 1]).generate_state(1)[0]) for first in (3, 4)]
    assert [venv._later_seed(i) for i in range(2)] == later
    venv.seed(8)
    venv.reset()
    assert venv._first_seeds == [8, 9]
    assert RayVecEnv([Corridor], 1, step_timeout=None)._later_seed(0) is None
    assert set(ray.timeouts) == {None}


@pytest.mark.parametrize("running", [True, False])
def test_environments_are_closed_and_their_actors_ended_once(ray: Ray, running: bool) -> None:
    venv = RayVecEnv([CountingEnv] * 3, 2)
    actors = list(venv._actors)
    ray.is_initialized = lambda: running
    venv.close()
    venv.close()
    assert [actor.lost for actor in actors] == [running] * 2
    assert ray.waited == ([(["closed"] * 2, 2, PATIENCE)] if running else [])
    assert venv.closed is True
