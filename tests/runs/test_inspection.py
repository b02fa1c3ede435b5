"""What is in an options file, for people, without the environment or the model."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from sb3_options import OptionBank
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import HalfSpace, Region
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from sb3_options.runs.inspection import contents_of, picture_of, summary_of, table_of

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
    plane = HalfSpace(np.array([[3.0, 0.0]]), ONE, 0.0, np.array([1.0, 0.0]))
    network = NetworkPolicy(np.zeros(2), ONE, [np.zeros((2, 3))], [np.zeros(3)])
    bank.add(reach(plane, near, network, policy_input="features"))
    group = FeatureGroup("door", (4, 7))
    own = Region(np.array([[1.0, 0.0]]), ONE, 0.0, group=group)
    bank.add(reach(own, Region(near.points, ONE, 0.5, group=group), policy_input="features"))
    named = FeatureGroup("key", (1, 2, 3), labels=("", "forward", "lateral"))
    ahead = Region(np.array([[1.0, 2.0, 0.0]]), np.ones(3), 0.0, group=named)
    bank.add(reach(ahead, ahead, table((0.0, 0.0, 0.0)), policy_input="features"))
    bank.save(tmp_path / "options.safetensors")
    return tmp_path / "options.safetensors"


def shown(path: Path) -> str:
    console = Console(width=150, no_color=True)
    with console.capture() as captured:
        console.print(table_of(contents_of(path)))
    return captured.get()


def test_every_option_has_a_row(file: Path) -> None:
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in shown(file).splitlines() if "│" in line]
    states = "2 states, radius 0.5"
    assert rows[0] == ["0", "reach 10, 5", "10, 5", "0.5", states, "table of 1 states on the observation", "40 steps"]
    assert rows[1][:3] == ["1", "turn round", "by hand: code, not in the file"]
    assert rows[2][2] == "beyond the plane through 3, 0"
    assert rows[2][5] == "network on the features"
    assert rows[3][2] == "door at 1, 0"
    assert rows[4][2] == "key at forward 2, lateral 0"


def test_what_holds_for_all(file: Path) -> None:
    contents = contents_of(file.parent)
    assert "5 of 6 slots are taken; policies choose among 3 primitive actions." in summary_of(contents)
    assert contents.digest in summary_of(contents)[-1]
    assert list(contents.options) == [0, 1, 2, 3, 4]


def test_a_picture_has_a_panel_for_each_discovered_option(file: Path, tmp_path: Path) -> None:
    figure = picture_of(contents_of(file))
    titles = ["10, 5", "beyond the plane through 3, 0", "door at 1, 0", "key at forward 2, lateral 0"]
    assert [axes.get_title() for axes in figure.axes] == [
        f"slot {slot}: {title}" for slot, title in zip((0, 2, 3, 4), titles, strict=True)
    ]
    assert figure.axes[2].get_xlabel() == "feature 5"
    assert figure.axes[2].get_ylabel() == "feature 8"
    assert figure.axes[3].get_xlabel() == "forward"
    assert figure.axes[3].get_ylabel() == "lateral"
    figure.savefig(tmp_path / "options.png")


def test_states_without_coordinates_lie_on_a_line(tmp_path: Path) -> None:
    code = np.eye(16)
    bank = OptionBank(3, 2)
    option = SubgoalOption(
        Region(code[9:10], np.ones(16), 0.5),
        Region(code[3:8], np.ones(16), 0.5),
        TabularPolicy(np.arange(3.0)[:, None], np.zeros((3, 3))),
    )
    bank.add(option)
    bank.save(tmp_path / "options.safetensors")
    contents = contents_of(tmp_path)._replace(features="categorical")
    axes = picture_of(contents).axes[0]
    assert axes.get_title() == "slot 0: state 9"
    assert axes.get_xlabel() == "number of the state"


def test_an_empty_file_and_one_that_is_none(tmp_path: Path) -> None:
    OptionBank(3, 2).save(tmp_path / "options.safetensors")
    assert "0 of 2 slots" in summary_of(contents_of(tmp_path))[0]
    assert picture_of(contents_of(tmp_path)).axes[0].texts[0].get_text() == "No discovered options."
    (tmp_path / "options.safetensors").write_bytes(b"\x08" * 40)
    with pytest.raises(ValueError, match="options file"):
        contents_of(tmp_path)
    with pytest.raises(FileNotFoundError):
        contents_of(tmp_path / "none")
