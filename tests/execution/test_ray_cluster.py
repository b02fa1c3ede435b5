import socket
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.common.machines import Machines
from experiments.common.seeds import run_seeds
from sb3_options.execution.ray_cluster import connect, emptiest, require_ray


def test_without_ray_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    text = r"^Ray is not installed: pip install 'sb3-options\[cluster\]' \(in a checkout .*\), on every machine\.$"
    with pytest.raises(ModuleNotFoundError, match=text):
        require_ray()
    with pytest.raises(ModuleNotFoundError, match=text):
        run_seeds(lambda seed: {}, [0], tmp_path, settings={}, on=Machines(cluster="auto"))


@pytest.mark.cluster
def test_where_there_is_no_cluster(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="needs Ray: pip install .[cluster]")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"  # nobody listens
        with pytest.raises(ConnectionError, match=rf"^No Ray cluster answers at '{address}': .* `ray start --head`"):
            connect(address)
        monkeypatch.setenv("RAY_ADDRESS", address)
        for named in ("auto", None):
            with pytest.raises(ConnectionError, match=rf"^No Ray cluster answers at '{address}'"):
                connect(named)
    monkeypatch.delenv("RAY_ADDRESS")
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    with pytest.raises(ConnectionError, match=r"^No Ray cluster was started on this machine, and RAY_ADDRESS names"):
        connect("auto")
    with pytest.raises(ConnectionError, match=r"^No Ray cluster answers at 'nonsense': "):
        connect("nonsense")


def test_actors_are_spread_by_cores() -> None:
    def node(name: str, cores: float, *, alive: bool = True) -> dict[str, object]:
        return {"NodeID": name, "Alive": alive, "Resources": {"CPU": cores} if cores else {}}

    nodes = [node("small", 2.0), node("large", 4.0), node("dead", 9.0, alive=False), node("head", 0.0)]
    ray = SimpleNamespace(nodes=lambda: nodes)
    taken: list[str | None] = []
    for _ in range(6):
        taken.append(emptiest(ray, taken))
    assert (taken.count("small"), taken.count("large")) == (2, 4)
    assert emptiest(ray, ["large"] * 9, avoid="small") == "large"
    assert emptiest(SimpleNamespace(nodes=lambda: [node("small", 2.0)]), [], avoid="small") == "small"
    assert emptiest(SimpleNamespace(nodes=lambda: [node("head", 0.0)]), []) is None
