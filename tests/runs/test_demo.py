"""The demonstration, on a small map: what it prints and leaves."""

import io
import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from rich.console import Console

from sb3_options.callbacks import DiscoveredOption
from sb3_options.options.bank import OptionBank
from sb3_options.runs import demo
from sb3_options.runs.commands import DemoConfig
from tests.support.sb3_helpers import SMALL_ROOMS


def small(max_steps: int, n_timesteps: int) -> dict[str, Any]:
    kwargs = {"map": SMALL_ROOMS, "max_steps": max_steps}
    return {"env": "sb3_options/TwoRooms-v0", "env_kwargs": kwargs, "n_timesteps": n_timesteps}


def test_a_demonstration_leaves_table_picture_film_and_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    claim = demo.CLAIMS["rooms"]._replace(source=small(100, 6_000), target=small(40, 2_000), cells=(9, 5))
    monkeypatch.setitem(demo.CLAIMS, "rooms", claim._replace(evaluate_every=1_000))
    monkeypatch.setattr(demo, "EVALUATION_EPISODES", 4)
    printed = io.StringIO()
    config = DemoConfig(out=tmp_path / "demo", seeds=1, seed=3, video=True, progress=False)
    demo.show_demo(config, Console(file=printed, width=120))
    with_option, without = json.loads((tmp_path / "demo/demo.json").read_text())
    assert (with_option["arm"], without["arm"]) == (demo.WITH, demo.WITHOUT)
    assert with_option["seed"] == without["seed"] == 3
    assert all(len(each["steps"]) == len(each["success"]) > 0 for each in (with_option, without))
    bank = OptionBank(4, 4)
    bank.load(tmp_path / "demo/options-3.safetensors")
    assert len(bank) == 1
    assert with_option["subgoals"] in printed.getvalue()
    assert iio.imread(tmp_path / "demo/demo.png").std() > 0
    film = iio.imread(tmp_path / "demo/demo.gif")
    assert len(film) > 2
    assert film.shape[2] > 2 * film.shape[1]  # two wide maps side by side


def test_subgoals_on_a_map_with_a_key_are_marked_at_their_cells() -> None:
    key = DiscoveredOption(0, 1, 100, np.array([0.0, 7.0, 5.0]), "0, 7, 5", log_density=0.0, initiation_states=9)
    results = [{"arm": arm, "steps": [1000], "success": [1.0]} for arm in demo.COLOURS]
    figure = demo.figure_of(results, demo.CLAIMS["key"], [key], np.zeros((80, 130, 3), np.uint8))
    assert np.array_equal(figure.axes[0].lines[0].get_xydata(), [[5.0, 75.0]])


def test_both_agents_have_the_same_settings(tmp_path: Path) -> None:
    claim = demo.CLAIMS["rooms"]
    one, other = demo._target(claim, 0, tmp_path / "options.safetensors"), demo._target(claim, 0, None)
    different = {name for name, value in vars(one).items() if getattr(other, name) != value}
    assert different == {"options"}
