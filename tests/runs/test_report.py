"""What came out of a run: the closing table, and the options of a file."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from sb3_options import OptionBank
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.options.file import opened
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from sb3_options.runs.commands import InspectConfig
from sb3_options.runs.report import option_rows, show_options

ONE = np.ones(2)


def table(*states: tuple[float, ...]) -> TabularPolicy:
    return TabularPolicy(np.array(states), np.zeros((len(states), 3)))


def reach(subgoal: Region, initiation: Region, policy: Any = None, **kwargs: Any) -> SubgoalOption:
    return SubgoalOption(subgoal, initiation, policy or table((0.0, 0.0)), **kwargs)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    bank = OptionBank(3, 6)
    near = Region(np.array([[1.0, 5.0], [2.0, 5.0]]), ONE, 0.5)
    bank.add(reach(Region(np.array([[10.0, 5.0]]), ONE, 0.5), near, name="reach 10, 5", max_duration=40))
    bank.add(Option(np.asarray, np.asarray, np.asarray, name="turn round"))
    place = Region(np.array([[3.0, 0.0]]), ONE, 0.5)
    network = NetworkPolicy(np.zeros(2), ONE, [np.zeros((2, 3))], [np.zeros(3)])
    bank.add(reach(place, near, network, policy_input="features"))
    group = FeatureGroup("door", (4, 7))
    own = Region(np.array([[1.0, 0.0]]), ONE, 0.0, group=group)
    bank.add(reach(own, Region(near.points, ONE, 0.5, group=group), policy_input="features"))
    named = FeatureGroup("key", (1, 2, 3), labels=("", "forward", "lateral"))
    ahead = Region(np.array([[1.0, 2.0, 0.0]]), np.ones(3), 0.0, group=named)
    bank.add(reach(ahead, ahead, table((0.0, 0.0, 0.0)), policy_input="features"))
    bank.save(tmp_path / "options.safetensors")
    return tmp_path / "options.safetensors"


def test_every_option_has_a_row(file: Path) -> None:
    rows = option_rows(opened(file), {0: 4_000})
    policy = "table of 1 states on the observation"
    assert rows[0] == ["0", "reach 10, 5", "10, 5", "4,000", "2", policy, "40 steps"]
    assert rows[1][:4] == ["1", "turn round", "by hand: code, not in the file", "given at the start"]
    assert rows[2][2] == "3, 0"
    assert rows[2][5] == "network on the features"
    assert [row[2] for row in rows[3:]] == ["door at 1, 0", "key at forward 2, lateral 0"]


def test_options_are_shown(file: Path) -> None:
    console = Console(width=200, no_color=True)
    with console.capture() as captured:
        show_options(InspectConfig(file.parent), console)
    shown = captured.get()
    assert "5 of 6 slots are taken; policies choose among 3 primitive actions." in shown
    assert opened(file).digest in shown
