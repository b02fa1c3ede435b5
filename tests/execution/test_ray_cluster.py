import sys
from pathlib import Path

import pytest

from experiments.common.machines import Machines
from experiments.common.seeds import run_seeds
from sb3_options.execution.ray_vec_env import require_ray


def test_without_ray_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    text = r"^Ray is not installed: pip install 'sb3-options\[cluster\]' \(in a checkout .*\), on every machine\.$"
    with pytest.raises(ModuleNotFoundError, match=text):
        require_ray()
    with pytest.raises(ModuleNotFoundError, match=text):
        run_seeds(lambda seed: {}, [0], tmp_path, settings={}, on=Machines(cluster="auto"))
