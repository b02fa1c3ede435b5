"""Trainings, searches and studies on a real cluster of two nodes, one of which is killed."""

import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.common.machines import Machines
from experiments.common.seeds import Part, run_parts
from experiments.kills.comparison import differences
from sb3_options import cli
from sb3_options.runs import folder as runs
from tests.support.clusters import TwoNodes, wait_until
from tests.support.sb3_helpers import make_optioned_rooms

pytest.importorskip("ray", reason="needs Ray: pip install .[cluster]")
pytestmark = [pytest.mark.cluster, pytest.mark.slow, pytest.mark.xdist_group("cluster")]  # one cluster at a time

FLAGS = (
    "ppo --n-envs 3 --n-timesteps 768 --n-steps 64 --batch-size 64 --n-epochs 1 --net-arch 8 --checkpoint-freq 300 "
    "--env-kwargs max_steps:50 --no-progress --device cpu"
)


def test_train_and_resume(nodes: TwoNodes, tmp_path: Path) -> None:
    def train(kind: str) -> Path:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        cli.main([*FLAGS.split(), "--vec-env", kind, "--tensorboard-log", str(folder)])
        (made,) = folder.glob("ppo/*")
        return made

    run, other = train("dummy"), train("ray")
    differ = {what: those for what, those in differences(run, other).items() if those}
    assert differ == {"TensorBoard": ["tensorboard_1/time/lost_actors"]}
    before = (other / runs.MODEL).read_bytes()
    (other / runs.MODEL).unlink()
    cli.main(["resume", str(other), "--no-progress"])
    assert (other / runs.MODEL).stat().st_size == pytest.approx(len(before), rel=0.1)
    differ = {what: those for what, those in differences(run, other).items() if those}
    assert differ == {"TensorBoard": ["tensorboard_1/time/lost_actors"]}


def kill_second(nodes: TwoNodes, folder: Path, sign: str) -> None:
    """Kill the second node as soon as a file says that something runs there."""
    wait_until(lambda: list(folder.glob(sign)))
    nodes.kill_second()


def walk(seed: int) -> dict[str, Any]:
    """A part of a study."""
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


def walk_at_home(folder: Path, home: str, seed: int) -> dict[str, Any]:
    """`walk`; at home it waits for the other node, of which Ray learns only after a while, and there until that is
    killed."""
    import ray

    if ray.is_initialized() and ray.get_runtime_context().get_node_id() != home:
        (folder / f"there-{seed}").touch()
        wait_until(lambda: False)
    elif ray.is_initialized():
        wait_until(lambda: list(folder.glob("there-*")))
    return walk(seed)


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*.json")}


def test_a_study_on_two_machines_one_of_which_is_lost(nodes: TwoNodes, tmp_path: Path) -> None:
    second = nodes.add_second()
    (home,) = [node["NodeID"] for node in nodes.ray.nodes() if node["Alive"] and node["NodeID"] != second]

    def study(out: Path, on: Machines) -> dict[str, list[dict[str, Any]]]:
        parts = [Part(name, partial(walk_at_home, tmp_path, home), out / name) for name in ("one", "other")]
        return run_parts(parts, range(3), settings={"steps": 500}, on=on)

    killer = threading.Thread(target=kill_second, args=(nodes, tmp_path, "there-*"))
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
