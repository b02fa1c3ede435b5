"""Ray: environments and studies on a real cluster of two nodes, one of which is killed."""

import logging
import os
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from experiments.common.machines import Machines
from experiments.common.seeds import Part, run_parts
from experiments.kills.comparison import differences
from sb3_options import OptionsWrapper, cli
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.execution import ray_vec_env
from sb3_options.execution.ray_vec_env import RayVecEnv
from sb3_options.execution.workers import WorkerLostError
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from tests.support.clusters import TwoNodes, nodes_of, two_nodes, wait_until
from tests.support.sb3_helpers import Corridor, fast_callback, make_optioned_rooms, places

pytest.importorskip("ray", reason="needs Ray: pip install .[cluster]")
pytestmark = [pytest.mark.cluster, pytest.mark.slow, pytest.mark.xdist_group("cluster")]  # one cluster at a time


@pytest.fixture(scope="module")
def nodes() -> Iterator[TwoNodes]:
    with two_nodes() as made:
        yield made


@pytest.fixture
def ray_envs(nodes: TwoNodes) -> Iterator[list[RayVecEnv]]:
    """Whatever a test puts in is ended after it."""
    made: list[RayVecEnv] = []
    yield made
    for venv in made:
        venv.close()


def corridor(kind: str) -> gym.Env[Any, Any]:
    return OptionsWrapper(Corridor(kind), 2, gamma=0.9, feature_map=places)


def same(one: Any, other: Any) -> bool:
    """Whether all numbers, and their types, are the same."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.flags.writeable and np.array_equal(one, other)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize("kind", ["box", "dict"])
def test_the_same_trajectories_as_in_worker_processes(kind: str, ray_envs: list[RayVecEnv]) -> None:
    make = partial(corridor, kind)
    venv, other = RayVecEnv([make] * 3, 2), SubprocVecEnv([make] * 3)
    ray_envs.append(venv)
    both: list[VecEnv] = [venv, other]
    assert venv.observation_space == other.observation_space
    for each in both:
        each.seed(3)
        each.env_method("expect_empty", True)
        each.env_method("report_availability", True, indices=[2, 0])
    assert same(venv.reset(), other.reset())
    random = np.random.default_rng(0)
    for _ in range(60):
        actions = random.integers(0, 4, 3)
        mine, theirs = (each.step(actions) for each in both)
        assert same(list(mine), [*theirs[:3], list(theirs[3])])
        assert same(list(venv.reset_infos), list(other.reset_infos))
    for indices in (None, 1, [2, 0]):
        assert same(*(each.env_method("action_masks", indices=indices) for each in both))
        assert same(*(each.get_attr("gamma", indices) for each in both))
    for each in both:
        each.set_attr("mark", 7, indices=[1])
        assert each.get_attr("mark", [1]) == [7]
        assert not each.has_attr("mark")
        assert each.env_is_wrapped(OptionsWrapper) == [True] * 3
    other.close()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        venv.get_attr("nothing")


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
    second = nodes.add_second()
    where: list[str] = []
    while where.count(second) != 1:  # nodes learn of one that has just joined only after a while
        venv = RayVecEnv([make_optioned_rooms] * 4, 2)
        ray_envs.append(venv)
        where = nodes_of(venv)
        assert len(ray_envs) < 20
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
    assert warned[0].startswith(f"Environments {lost[0]} to {lost[1]} of 4: the machine or the process is gone (")
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
        nodes.ray.get(actor.make.remote())
    except nodes.ray.exceptions.RayActorError:
        return True
    return False


def test_what_is_lost_before_the_first_reset_has_lost_nothing(nodes: TwoNodes, ray_envs: list[RayVecEnv]) -> None:
    begun: list[list[float]] = []
    for lost in (False, True):
        venv = RayVecEnv([make_optioned_rooms] * 2, 1)
        ray_envs.append(venv)
        venv.seed(5)
        venv.set_attr("mark", 7)
        if lost:
            nodes.ray.kill(venv._actors[0])
            wait_until(lambda: is_dead(nodes, venv._actors[0]))  # noqa: B023  # it is waited for here
        observations: Any = venv.reset()
        assert venv.get_attr("mark") == [7, 7]
        assert venv.lost_actors == 0
        begun.append(observations.tolist())
    assert begun[0] == begun[1]


def test_a_machine_hangs(nodes: TwoNodes, ray_envs: list[RayVecEnv], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_vec_env, "CHECK_EVERY", 0.5)
    second = nodes.add_second()
    where: list[str] = []
    while where.count(second) != 1:  # nodes learn of one that has just joined only after a while
        venv = RayVecEnv([make_optioned_rooms] * 2, 2)
        ray_envs.append(venv)
        where = nodes_of(venv)
        assert len(ray_envs) < 20
    venv.reset()
    step: Callable[[Any], Any] = venv.step
    step(np.zeros(2, dtype=np.int64))
    with nodes.hanging_second():
        dones = step(np.zeros(2, dtype=np.int64))[2]
    assert dones.tolist() == [place == second for place in where]
    assert venv.lost_actors == 1
    assert second not in nodes_of(venv)
    assert not step(np.zeros(2, dtype=np.int64))[2].any()


def test_what_is_lost_between_two_steps(nodes: TwoNodes, ray_envs: list[RayVecEnv]) -> None:
    venv = RayVecEnv([make_optioned_rooms] * 2, 1)
    ray_envs.append(venv)
    venv.seed(5)
    reset: Callable[[], Any] = venv.reset
    before = reset().copy()
    venv.set_attr("mark", 7, indices=1)
    nodes.ray.kill(venv._actors[0])
    assert [mask.tolist() for mask in venv.env_method("action_masks")] == [[True] * 4 + [False] * 4] * 2
    assert venv.get_attr("mark", 1) == [7]
    step: Callable[[Any], Any] = venv.step
    observations, rewards, dones, infos = step(np.zeros(2, dtype=np.int64))
    assert (rewards.tolist(), dones.tolist(), venv.lost_actors) == ([0.0, 0.0], [True, True], 1)
    for i in range(2):
        assert infos[i]["terminal_observation"].tolist() == before[i].tolist()
    assert not venv.step(np.zeros(2, dtype=np.int64))[2].any()
    nodes.ray.kill(venv._actors[0])
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
    monkeypatch.setattr(ray_vec_env, "MOST_LOSSES", 1)
    with pytest.raises(ValueError, match=r"^left is the only way$"):
        venv.step(np.array([1]))
    venv.step(np.array([0]))
    with pytest.raises(WorkerLostError, match=r"^Environment 0 of 1: lost 2 times without a step between\. .* memory"):
        venv.step(np.array([0]))


FLAGS = (
    "ppo --n-envs 3 --n-timesteps 768 --n-steps 64 --batch-size 64 --n-epochs 1 --net-arch 8 --checkpoint-freq 300 "
    "--env-kwargs max_steps:50 --no-progress --device cpu"
)


def unharmed(call: Callable[[], object], caplog: pytest.LogCaptureFixture) -> bool:
    """Whether Ray lost no actor of its own accord, as it may on a busy machine."""
    caplog.clear()
    call()
    return not any("start anew" in record.getMessage() for record in caplog.records)


def test_train_and_resume(nodes: TwoNodes, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def train(kind: str, attempt: int = 0) -> Path:
        folder = tmp_path / f"{kind}-{attempt}"
        cli.main([*FLAGS.split(), "--vec-env", kind, "--tensorboard-log", str(folder)])
        (made,) = folder.glob("ppo/*")
        return made

    run, made = train("dummy"), []
    assert any(unharmed(lambda n=n: made.append(train("ray", n)), caplog) for n in range(3))  # type: ignore[misc]  # n is bound
    other = made[-1]
    differ = {what: those for what, those in differences(run, other).items() if those}
    assert differ == {"TensorBoard": ["tensorboard_1/time/lost_actors"]}
    before = (other / runs.MODEL).read_bytes()
    (other / runs.MODEL).unlink()
    cli.main(["resume", str(other), "--no-progress"])
    assert (other / runs.MODEL).stat().st_size == pytest.approx(len(before), rel=0.1)
    differ = {what: those for what, those in differences(run, other).items() if those}
    assert differ == {"TensorBoard": ["tensorboard_1/time/lost_actors"]}


def test_a_search_for_settings(nodes: TwoNodes, tmp_path: Path) -> None:
    space = {
        "base": {"algo": "ppo", "env": "CartPole-v1", "n_timesteps": 300, "n_envs": 1, "discover": False},
        "search": {"n_steps": [32, 64]},
    }
    (tmp_path / "space.yml").write_text(yaml.safe_dump(space))
    told = ["--trials", "2", "--seeds", "1", "--reach", "return=5", "--jobs", "2", "--cluster", nodes.address]
    cli.main(["tune", str(tmp_path / "space.yml"), "--out", str(tmp_path / "out"), *told])
    assert configs.load(tmp_path / "out" / "best.yml").algo == "ppo"
    assert len(list(tmp_path.glob("out/runs/*/0/score.json"))) == 2
    # Each was a task of its own.
    assert len(list(tmp_path.glob("out/runs/*/0/output.txt"))) == 2


def walk(folder: Path, home: str, seed: int) -> dict[str, Any]:
    """A part of a study; on another node it waits until that is killed."""
    import ray

    if ray.is_initialized() and ray.get_runtime_context().get_node_id() != home:
        (folder / f"there-{seed}").touch()
        wait_until(lambda: False)
    env = make_optioned_rooms()
    total, length = 0.0, 0
    env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(500):
        _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        total, length = total + float(reward), length + 1
        if terminated or truncated:
            env.reset()
    return {"return": total, "length": length, "random": float(np.random.default_rng(seed).random())}


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*.json")}


def test_a_study_on_two_machines_one_of_which_is_lost(nodes: TwoNodes, tmp_path: Path) -> None:
    second = nodes.add_second()
    (home,) = [node["NodeID"] for node in nodes.ray.nodes() if node["Alive"] and node["NodeID"] != second]

    def study(out: Path, on: Machines) -> dict[str, list[dict[str, Any]]]:
        parts = [Part(name, partial(walk, tmp_path, home), out / name) for name in ("one", "other")]
        return run_parts(parts, range(3), settings={"steps": 500}, on=on)

    def kill() -> None:
        wait_until(lambda: list(tmp_path.glob("there-*")))
        nodes.kill_second()

    killer = threading.Thread(target=kill)
    killer.start()
    spread = study(tmp_path / "two", Machines(cluster=nodes.address))
    killer.join()
    assert list(tmp_path.glob("there-*"))
    nodes.ray.shutdown()
    alone = study(tmp_path / "one", Machines(jobs=1))
    nodes.ray.init(address=nodes.address, log_to_driver=False)
    assert spread == alone
    assert files(tmp_path / "two") == files(tmp_path / "one")
    assert len(files(tmp_path / "two")) == 6
