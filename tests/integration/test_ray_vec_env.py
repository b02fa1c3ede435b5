"""`RayVecEnv` on a real cluster of two nodes, one of which is killed."""

import logging
import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.execution import ray_vec_env
from sb3_options.execution.ray_vec_env import RayVecEnv
from sb3_options.execution.workers import WorkerLostError
from tests.support.clusters import TwoNodes, nodes_of, send, wait_until
from tests.support.sb3_helpers import Corridor, fast_callback, make_optioned_rooms, places

pytest.importorskip("ray", reason="needs Ray: pip install .[cluster]")
pytestmark = [pytest.mark.cluster, pytest.mark.slow, pytest.mark.xdist_group("cluster")]  # one cluster at a time


def corridor(kind: str) -> gym.Env[Any, Any]:
    return OptionsWrapper(Corridor(kind), 2, gamma=0.9, feature_map=places)


def same(one: Any, other: Any) -> bool:
    """Whether all numbers, and their types, are the same."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize("kind", ["box", "dict"])
def test_the_same_trajectories_as_in_worker_processes(
    kind: str, ray_envs: list[RayVecEnv], request: pytest.FixtureRequest
) -> None:
    make = partial(corridor, kind)
    venv, other = RayVecEnv([make] * 3, 2), SubprocVecEnv([make] * 3)
    ray_envs.append(venv)
    request.addfinalizer(other.close)
    both: list[VecEnv] = [venv, other]
    assert venv.observation_space == other.observation_space
    for each in both:
        each.seed(3)
        each.env_method("set_slots", expect_empty=True)
        each.env_method("set_slots", report_availability=True, indices=[2, 0])
    assert same(venv.reset(), other.reset())
    random = np.random.default_rng(0)
    for _ in range(60):
        actions = random.integers(0, 4, 3)
        mine, theirs = (each.step(actions) for each in both)
        assert same(list(mine), list(theirs))
        assert same(list(venv.reset_infos), list(other.reset_infos))
    for indices in (None, 1, [2, 0]):
        assert same(*(each.env_method("action_masks", indices=indices) for each in both))
        assert same(*(each.get_attr("gamma", indices) for each in both))
    for each in both:
        each.set_attr("mark", 7, indices=[1])
        assert each.get_attr("mark", [1]) == [7]
        assert not each.has_attr("mark")
        assert each.env_is_wrapped(OptionsWrapper) == [True] * 3
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        venv.get_attr("nothing")


def one_on_each(
    nodes: TwoNodes, ray_envs: list[RayVecEnv], make: Callable[[], Any], n_envs: int
) -> tuple[RayVecEnv, list[str]]:
    """Environments in two actors, one on each node, and the nodes."""
    second = nodes.add_second()
    for _ in range(20):  # nodes learn of one that has just joined only after a while
        venv = RayVecEnv([make] * n_envs, 2)
        ray_envs.append(venv)
        where = nodes_of(venv)
        if where.count(second) == 1:
            return venv, where
    raise AssertionError(where)


class KillNode(BaseCallback):
    """Kills the second node in mid-training, once there is an option; notes what is said of lost steps."""

    def __init__(self, nodes: TwoNodes, discovery: SubgoalDiscoveryCallback) -> None:
        super().__init__()
        self.nodes, self.discovery = nodes, discovery
        self.lost: list[tuple[int, dict[str, Any]]] = []
        self.n_after = 0

    def _on_step(self) -> bool:
        if self.nodes.second is not None and self.discovery.discoveries and self.num_timesteps >= 1_500:
            self.nodes.kill_second()
        self.lost += [(i, info) for i, info in enumerate(self.locals["infos"]) if "lost" in info]
        self.n_after += bool(self.lost)
        return self.n_after < 300


def test_a_machine_is_lost_in_mid_training(
    nodes: TwoNodes, ray_envs: list[RayVecEnv], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.clear()
    second = nodes.add_second()
    venv, where = one_on_each(nodes, ray_envs, make_optioned_rooms, 4)
    model = PPO("MlpPolicy", venv, gamma=0.9, n_steps=64, batch_size=64, n_epochs=1, seed=0)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    discovery = fast_callback()
    kill = KillNode(nodes, discovery)
    with caplog.at_level(logging.WARNING, "sb3_options"):
        model.learn(1_000_000, callback=[discovery, kill])
    model.logger.close()
    assert venv.lost_actors == 1
    assert second not in nodes_of(venv)
    lost = [2, 3] if where[1] == second else [0, 1]
    assert [i for i, _ in kill.lost] == lost
    for _, info in kill.lost:
        assert info["TimeLimit.truncated"] is True
        assert info["terminal_observation"].shape == venv.observation_space.shape
        assert (info["option"]["duration"], info["option"]["termination"]) == (1, "truncated")
    warned = [record.getMessage() for record in caplog.records if "start anew" in record.getMessage()]
    assert len(warned) == 1
    assert warned[0].startswith(f"Environments {lost} of 4: the machine or the process is gone (")
    # Options and recording are in the new environments, too.
    assert [bank.filled for bank in venv.get_attr("bank")] == [discovery.bank.filled] * 4
    assert {*discovery.bank.filled} == {0}
    observations = np.eye(45, dtype=np.float32)
    assert len({mask.tobytes() for mask in venv.env_method("available", observations)}) == 1
    ended: list[tuple[Any, Any]] = []
    venv.seed(0)
    venv.reset()
    while len({i for i, _ in ended}) < 4:
        _, _, dones, infos = venv.step(np.random.default_rng(len(ended)).integers(0, 4, 4))
        ended += [(i, infos[i]["trajectory"]) for i in np.flatnonzero(dones)]
    columns, *rows = [line.split(",") for line in (tmp_path / "progress.csv").read_text().splitlines()]
    counted = [row[columns.index("time/lost_actors")] for row in rows]
    assert (counted[0], counted[-1]) == ("0", "1")


def is_dead(nodes: TwoNodes, actor: Any) -> bool:
    try:
        nodes.ray.get(actor.answer.remote([]))
    except nodes.ray.exceptions.RayActorError:
        return True
    return False


def kill(nodes: TwoNodes, actor: Any) -> None:
    """Ray may let it answer a little longer, so its end is waited for."""
    nodes.ray.kill(actor)
    wait_until(lambda: is_dead(nodes, actor))


@pytest.mark.parametrize(
    ("number", "workers"), [(signal.SIGSTOP, True), (signal.SIGKILL, False)], ids=["it hangs", "its raylet is killed"]
)
def test_a_machine_does_not_answer(
    number: signal.Signals, workers: bool, nodes: TwoNodes, ray_envs: list[RayVecEnv]
) -> None:
    second = nodes.add_second()
    venv, where = one_on_each(nodes, ray_envs, make_optioned_rooms, 2)
    venv.reset()
    step: Callable[[Any], Any] = venv.step
    infos = step(np.zeros(2, dtype=np.int64))[3]
    with nodes.second_gets(number, workers=workers):
        while not venv.lost_actors:  # the workers of a raylet that is killed go on for a while
            infos = step(np.zeros(2, dtype=np.int64))[3]
    assert ["lost" in info for info in infos] == [place == second for place in where]
    assert venv.lost_actors == 1
    assert second not in nodes_of(venv)
    assert not any("lost" in info for info in step(np.zeros(2, dtype=np.int64))[3])


def test_a_process_hangs(nodes: TwoNodes, ray_envs: list[RayVecEnv]) -> None:
    venv = RayVecEnv([make_optioned_rooms] * 2, 1)
    ray_envs.append(venv)
    venv.seed(5)
    reset: Callable[[], Any] = venv.reset
    before = reset().copy()
    pid = nodes.ray.get(venv._actors[0].__ray_call__.remote(lambda _: os.getpid()))
    send(signal.SIGSTOP, [pid])
    patience, venv.step_timeout = venv.step_timeout, 1.0
    step: Callable[[Any], Any] = venv.step
    _, rewards, dones, infos = step(np.zeros(2, dtype=np.int64))
    venv.step_timeout = patience
    assert (rewards.tolist(), dones.tolist(), venv.lost_actors) == ([0.0, 0.0], [True, True], 1)
    assert infos[1]["terminal_observation"].tolist() == before[1].tolist()
    assert not step(np.zeros(2, dtype=np.int64))[2].any()
    wait_until(lambda: not Path(f"/proc/{pid}").exists())


def test_what_is_lost_between_two_steps(nodes: TwoNodes, ray_envs: list[RayVecEnv]) -> None:
    venv = RayVecEnv([make_optioned_rooms] * 2, 1)
    ray_envs.append(venv)
    venv.seed(5)
    reset: Callable[[], Any] = venv.reset
    before = reset().copy()
    kill(nodes, venv._actors[0])
    assert [mask.tolist() for mask in venv.env_method("action_masks")] == [[True] * 4 + [False] * 4] * 2
    step: Callable[[Any], Any] = venv.step
    observations, rewards, dones, infos = step(np.zeros(2, dtype=np.int64))
    assert (rewards.tolist(), dones.tolist(), venv.lost_actors) == ([0.0, 0.0], [True, True], 1)
    for i in range(2):
        assert infos[i]["terminal_observation"].tolist() == before[i].tolist()
    assert not venv.step(np.zeros(2, dtype=np.int64))[2].any()
    kill(nodes, venv._actors[0])
    venv.seed(5)
    assert reset().tolist() == before.tolist()  # what is reset anyway has lost nothing
    assert not venv.step(np.zeros(2, dtype=np.int64))[2].any()
    assert observations.shape == before.shape


class Ends(Corridor):
    """Ends its process, or raises an error, at the first step."""

    def step(self, action: int) -> Any:
        if action == 1:
            raise ValueError("left is the only way")
        os._exit(1)


def test_faults_of_environments(nodes: TwoNodes, ray_envs: list[RayVecEnv], monkeypatch: pytest.MonkeyPatch) -> None:
    venv = RayVecEnv([Ends], 1)
    ray_envs.append(venv)
    venv.reset()
    with monkeypatch.context() as patched:
        patched.setattr(ray_vec_env, "MOST_LOSSES", 1)
        with pytest.raises(ValueError, match=r"^left is the only way$"):
            venv.step(np.array([1]))
        venv.step(np.array([0]))
        text = r"^Environments \[0\] of 1: lost 2 times without a step between\. .* memory"
        with pytest.raises(WorkerLostError, match=text):
            venv.step(np.array([0]))
