"""Checkpoints from strangers: `resume` runs none, writes nothing elsewhere, and says one clear line.

Each is written with the right digest, by somebody who knows the format, unless it is no checkpoint at all.
"""

import json
import os
import pickle
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save as to_safetensors

from sb3_options import cli
from sb3_options.checkpoints.file import FORMAT, CheckpointFolder, read
from sb3_options.checkpoints.tree import encode
from sb3_options.options.sealed import Arrays, digest
from sb3_options.runs import folder as runs
from tests.support.runs import Refused

FLAGS = (
    "ppo --n-timesteps 256 --n-envs 1 --n-steps 64 --batch-size 64 --n-epochs 1 --net-arch 8 --eval-freq 0 "
    "--checkpoint-freq 100 --env-kwargs max_steps:20 --no-progress --device cpu"
)


class Evil:
    """Unpickling one leaves a trace."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return Path.mkdir, (self.trace,)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that can be resumed."""
    folder = tmp_path_factory.mktemp("runs")
    cli.main([*FLAGS.split(), "--tensorboard-log", str(folder)])
    (run,) = folder.glob("ppo/*")
    return run


def packed(state: str, arrays: Arrays | None = None, *, blocks: str = "{}", seal: str | None = None) -> bytes:
    """A checkpoint that says this."""
    texts = {"state": state, "blocks": blocks}
    about = {"format": FORMAT, **texts, "digest": seal or digest(texts, arrays or {})}
    content: bytes = to_safetensors(arrays or {}, metadata=about)
    return content


def with_header(header: bytes, length: int | None = None) -> bytes:
    return (len(header) if length is None else length).to_bytes(8, "little") + header


Make = Callable[[dict[str, Any], Path], bytes]


def changed(change: Callable[[dict[str, Any], Path], object]) -> Make:
    """The state of a real checkpoint with a change."""

    def make(state: dict[str, Any], trace: Path) -> bytes:
        change(state, trace)
        content, arrays = encode(state)
        return packed(json.dumps(content), arrays)

    return make


def put(value: Any, *path: str | int) -> Make:
    """The state with another value in the place that a path leads to."""

    def change(state: Any, _: Path) -> None:
        *there, last = path
        for each in there:
            state = state[each]
        state[last] = value

    return changed(change)


def plain(state: str, **more: Any) -> Make:
    return lambda _, __: packed(state, **more)


def blocks(**about: Any) -> str:
    whole: dict[str, Any] = {"shape": [4], "dtype": "<f8", "names": ["0" * 64]}
    return json.dumps({"0": whole | about})


DAMAGED, MISFIT = "is no checkpoint, or it is damaged", "does not fit what is trained here"
REFUSED: dict[str, tuple[Make, str]] = {
    "a pickle": (lambda _, trace: pickle.dumps(Evil(trace)), "is no checkpoint"),
    "a pickle behind a header": (lambda _, trace: packed("{}") + pickle.dumps(Evil(trace)), DAMAGED),
    "nothing": (lambda _, __: b"", "is no checkpoint"),
    "a header beyond the file": (lambda _, __: with_header(b"{}", 1 << 62), "is no checkpoint"),
    "a deep header": (lambda _, __: with_header(b"[" * 50_000), "is no checkpoint"),
    "another format": (lambda _, __: to_safetensors({}, metadata={"format": "options 1"}), "its format is 'options 1'"),
    "a wrong digest": (plain("{}", seal="0" * 64), "its contents are not what was written to it"),
    "no state": (plain("null"), "it holds no state"),
    "a deep state": (plain("[" * 50_000), DAMAGED),
    "many digits": (plain('{"model": ' + "9" * 5_000 + "}"), DAMAGED),
    "an empty state": (plain("{}"), "is no checkpoint of a training: KeyError('model')"),
    **{
        f"{n} steps": (
            plain(f'{{"model": {{"class": "PPO", "counters": {{"num_timesteps": {n}}}}}}}'),
            "is no checkpoint of",
        )
        for n in ("Infinity", "-1", "0.5", "true", '"9"')
    },
    "a negative count of updates": (put(-1, "model", "counters", "_n_updates"), "The checkpoint has _n_updates=-1"),
    "a rollout too large": (put(10**12, "model", "rollout", "n_steps"), "of rollouts of 1000000000000 steps"),
    "a class to make": (plain('{"model": {"$": "os.system", "fields": {}}}'), "it holds a 'os.system', which is not"),
    "a record of other fields": (plain('{"a": {"$": "Region", "fields": {"command": "ls"}}}'), "or it is damaged"),
    "a block elsewhere": (plain("{}", blocks=blocks(names=["../../config"])), "is no name of a block"),
    "a block that is not there": (plain("{}", blocks=blocks()), DAMAGED),
    "no blocks": (plain("{}", blocks=blocks(names=[])), DAMAGED),
    "blocks that are deep": (plain("{}", blocks="[" * 50_000), DAMAGED),
    "another model": (put("os.system", "model", "class"), "The checkpoint is of os.system, the model is PPO"),
    "a policy of other sizes": (put(np.zeros((3, 3)), "model", "policy", "value_net.weight"), MISFIT),
    "no policy": (changed(lambda s, _: s["model"].pop("policy")), f"{MISFIT}: KeyError"),
    "other callbacks": (put("Evil", "callbacks", 0, "class"), "The checkpoint was written with callback 'Evil'"),
    "another wrapper": (put("Evil", "environments", 0, "environments", 0, 0, "class"), "its checkpoint is of Evil"),
    "a generator of another kind": (put(("evil", 1, 2, 3, 4), "random", "numpy"), "MT19937"),
    "event files of no size": (changed(lambda s, _: s.update({"event_files": {"evil": "x"}, "logged": 3})), MISFIT),
}


def files(folder: Path) -> dict[str, bytes]:
    """What is in it, but for what TensorBoard begins for each training."""
    found = {}
    for path in folder.rglob("*"):
        if path.is_file() and "tfevents" not in path.name and "__pycache__" not in path.parts:
            found[str(path.relative_to(folder))] = path.read_bytes()
    return found


def stranger(whole: Path, folder: Path, make: Make, trace: Path) -> Path:
    """A run that has not ended, and whose only checkpoint is this one."""
    run = Path(shutil.copytree(whole, folder / "run"))
    (run / runs.MODEL).unlink()
    there = list(CheckpointFolder(run / runs.CHECKPOINTS))
    content = make(read(there[0]), trace)
    for file in there:
        file.unlink()
    there[0].write_bytes(content)
    return run


@pytest.mark.parametrize("name", REFUSED)
def test_is_refused_in_one_line(name: str, whole: Path, tmp_path: Path, refused: Refused) -> None:
    make, expected = REFUSED[name]
    trace = tmp_path / "ran"
    run = stranger(whole, tmp_path, make, trace)
    before, modules = files(tmp_path), set(sys.modules)
    assert expected in refused("resume", str(run), "--no-progress")
    assert not trace.exists()
    after, monitor = files(tmp_path), f"run/{runs.MONITOR}/0.monitor.csv"
    assert before.pop(monitor).startswith(after.pop(monitor)), "it is cut to the checkpoint, nothing else"
    assert after == before
    assert not {module for module in set(sys.modules) - modules if "evil" in module}


def name_attributes(state: dict[str, Any], trace: Path) -> None:
    """Have whatever takes attributes from a file write to another place, and run something else."""
    paths = {"save_path": str(trace), "log_path": str(trace), "best_model_save_path": str(trace)}
    for callback in state["callbacks"]:
        callback["known"].update(paths)
    state["model"]["counters"].update({"save": "x", "tensorboard_log": str(trace), "get_env": None})
    state["model"]["last"].update({"learn": "x", "policy": None})
    state["event_files"] = {"../../evil": 0, str(trace): 0}


def test_names_no_attributes_and_no_paths(whole: Path, tmp_path: Path) -> None:
    trace = tmp_path / "ran"
    run = stranger(whole, tmp_path, changed(name_attributes), trace)
    (tmp_path / "evil").write_text("not to be cut")
    cli.main(["resume", str(run), "--no-progress"])
    assert not trace.exists()
    assert (tmp_path / "evil").read_text() == "not to be cut"
    assert (run / runs.MODEL).read_bytes()[:2] == b"PK"


def test_a_monitor_file_is_cut_and_never_made_longer(whole: Path, tmp_path: Path) -> None:
    def enlarge(state: dict[str, Any], _: Path) -> None:
        for layer in state["environments"][0]["environments"][0]:
            if "bytes" in layer:
                layer["bytes"] = 1 << 50

    run = stranger(whole, tmp_path, changed(enlarge), tmp_path / "ran")
    cli.main(["resume", str(run), "--no-progress"])
    (monitor,) = (run / runs.MONITOR).iterdir()
    assert monitor.stat().st_size < 10_000


@pytest.mark.parametrize("where", [runs.MONITOR, f"{runs.MONITOR}/0.monitor.csv", "tensorboard_1/x.tfevents", "pipe"])
def test_nothing_is_written_through_links(where: str, whole: Path, tmp_path: Path, refused: Refused) -> None:
    users = tmp_path / "users"
    users.mkdir()
    (users / "0.monitor.csv").write_text("the user's own " * 1000)
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    place = run / where
    place.parent.mkdir(exist_ok=True)
    if where == runs.MONITOR:
        shutil.rmtree(place)
        place.symlink_to(users)
    elif where == "pipe":
        os.mkfifo(place)
    else:
        place.unlink(missing_ok=True)
        place.symlink_to(users / "0.monitor.csv")
    assert "is a link, or neither a file nor a folder" in refused("resume", str(run), "--no-progress")
    assert (users / "0.monitor.csv").read_text() == "the user's own " * 1000
