"""What came out of a run: the closing table, the card, and the options of a file."""

import re
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console

from sb3_options import OptionBank
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from sb3_options.runs import report
from sb3_options.runs.commands import InspectConfig
from sb3_options.runs.config import configure
from sb3_options.runs.pictures import options_picture
from sb3_options.runs.report import CARD, LAST, Trained, contents_of, measures, option_rows, show_options, write_card

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


def trained(folder: Path, history: list[EpisodeRecord] | None = None, **settings: Any) -> Trained:
    discovered = [SimpleNamespace(slot=0, timestep=4_000), SimpleNamespace(slot=2, timestep=5_000)]
    discovery: Any = SimpleNamespace(history=history or [], discoveries=discovered)
    return Trained(configure(**settings), folder, discovery, finished=True, interrupted=False)


class TestOptions:
    def test_every_option_has_a_row(self, file: Path) -> None:
        rows = option_rows(contents_of(file), {0: 4_000})
        policy = "table of 1 states on the observation"
        assert rows[0] == ["0", "reach 10, 5", "10, 5", "4,000", "2", policy, "40 steps"]
        assert rows[1][:4] == ["1", "turn round", "by hand: code, not in the file", "given at the start"]
        assert rows[2][2] == "3, 0"
        assert rows[2][5] == "network on the features"
        assert [row[2] for row in rows[3:]] == ["door at 1, 0", "key at forward 2, lateral 0"]

    def test_they_are_shown_and_drawn(self, file: Path, tmp_path: Path) -> None:
        console = Console(width=200, no_color=True)
        with console.capture() as captured:
            show_options(InspectConfig(file.parent, tmp_path / "options.png"), console)
        shown = captured.get()
        assert "5 of 6 slots are taken; policies choose among 3 primitive actions." in shown
        assert contents_of(file).digest in shown
        assert (tmp_path / "options.png").stat().st_size > 5_000

    def test_a_picture_has_a_panel_for_each_discovered_option(self, file: Path) -> None:
        contents = contents_of(file)
        figure = options_picture(contents.options, dict.fromkeys((0, 2, 3, 4), "there"), contents.features)
        assert [axes.get_title() for axes in figure.axes] == [f"slot {slot}: there" for slot in (0, 2, 3, 4)]
        assert (figure.axes[2].get_xlabel(), figure.axes[2].get_ylabel()) == ("feature 5", "feature 8")
        assert (figure.axes[3].get_xlabel(), figure.axes[3].get_ylabel()) == ("forward", "lateral")

    def test_states_without_coordinates_lie_on_a_line(self) -> None:
        code = np.eye(16)
        option = SubgoalOption(
            Region(code[9:10], np.ones(16), 0.5),
            Region(code[3:8], np.ones(16), 0.5),
            TabularPolicy(np.arange(3.0)[:, None], np.zeros((3, 3))),
        )
        assert report.subgoal_of(option, "categorical") == "state 9"
        axes = options_picture({0: option}, {0: "state 9"}, "categorical").axes[0]
        assert axes.get_xlabel() == "number of the state"

    def test_an_empty_file_and_damaged_ones(self, tmp_path: Path) -> None:
        file = tmp_path / "options.safetensors"
        OptionBank(3, 2).save(file)
        assert contents_of(tmp_path).options == {}
        assert options_picture({}, {}, None).axes[0].texts[0].get_text() == "No discovered options."
        file.write_bytes(b"\x08" * 40)
        with pytest.raises(ValueError, match="options file"):
            contents_of(tmp_path)
        with pytest.raises(FileNotFoundError):
            contents_of(tmp_path / "none")


class TestCard:
    def test_names_options_numbers_and_settings(self, file: Path) -> None:
        history = [EpisodeRecord(10 * (i + 1), 1.0, True, 10) for i in range(3)]
        settings: dict[str, Any] = {"env_kwargs": {"max_steps": 300}, "n_timesteps": 900, "discovery": {"decay": 0.5}}
        write_card(trained(file.parent, history, seed=3, n_epochs=4, **settings))
        text = (file.parent / CARD).read_text()
        front, body = text.split("---\n")[1:]
        assert yaml.safe_load(front)["library_name"] == "stable-baselines3"
        assert "| 0 | reach 10, 5 | 10, 5 | 4,000 | 2 |" in body
        assert "| success rate, all episodes | 1 |" in body
        assert " steps, its seed 3: one run, and no study" in body
        assert contents_of(file).digest in body
        (changed,) = re.findall(r"```yaml\n(.*?)```", body, re.DOTALL)
        assert yaml.safe_load(changed) == settings | {"algo_kwargs": {"n_epochs": 4}}

    @pytest.mark.parametrize(
        ("settings", "lines"),
        [
            (
                {"env": "MiniGrid-Empty-5x5-v0"},
                ["from sb3_options.envs.minigrid import make", "env = make('MiniGrid-Empty-5x5-v0')"],
            ),
            (
                {"env_wrapper": "mine.here:Wrap", "feature_map": "mine:phi"},
                ["from mine.here import Wrap", "env = Wrap(env)", "from mine import phi"],
            ),
            ({"feature_map": "temporal-distance"}, []),
        ],
    )
    def test_its_program_has_wrappers_and_maps(self, settings: dict[str, Any], lines: list[str], file: Path) -> None:
        write_card(trained(file.parent, **settings))
        (program,) = re.findall(r"```python\n(.*?)```", (file.parent / CARD).read_text(), re.DOTALL)
        assert set(lines) <= set(program.splitlines())
        phi = settings.get("feature_map")
        assert ("feature_map=phi" in program) == (phi == "mine:phi")
        assert ("feature_map='temporal-distance'" in program) == (phi == "temporal-distance")


def episodes(outcomes: list[bool], steps: int = 10) -> list[EpisodeRecord]:
    return [EpisodeRecord(steps * (i + 1), float(good), good, steps) for i, good in enumerate(outcomes)]


def test_the_last_episodes_apart_from_all(tmp_path: Path) -> None:
    history = episodes([False] * LAST, 50) + episodes([True] * LAST, 10)
    shown = {name: cells for name, *cells in measures({"a": trained(tmp_path, history), "b": trained(tmp_path)})}
    assert shown["success rate, last 100 episodes"] == ["1", "–"]
    assert shown["success rate, all episodes"] == ["0.5", "–"]
    assert shown["primitive steps, all episodes"] == ["30", "–"]
    assert shown["episodes"] == ["200", "0"]


def commands(folder: Path, *, draws: bool = True) -> dict[str, list[str]]:
    """The words of what is printed, as a shell takes them, by its heading."""
    console = Console(width=400, no_color=True)
    with console.capture() as captured:
        report._next_commands(console, trained(folder, algo="ppo"), draws=draws)
    lines = [line.partition(":") for line in captured.get().splitlines()]
    return {name: shlex.split(rest) for name, _, rest in lines}


@pytest.mark.parametrize(
    ("program", "seen_from", "shown"),
    [
        ("train.py", "checkout", "train.py"),
        ("../checkout/train.py", "else where", "../checkout/train.py"),
        ("{root}/else where/train.py", "checkout", "../else where/train.py"),
        ("{root}/checkout/pytest", "checkout", "train.py"),
        ("{root}/bin/sb3-options", "checkout", "../bin/sb3-options"),
        ("{root}/site/sb3_options/__main__.py", "checkout", "sb3_options"),
    ],
)
def test_the_next_command_finds_the_program(
    program: str, seen_from: str, shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / seen_from).mkdir()
    monkeypatch.chdir(tmp_path / seen_from)
    monkeypatch.setattr("sys.argv", [program.format(root=tmp_path)])
    words = commands(Path("runs/ppo"))["Evaluate"]
    assert words[words.index("evaluate") - 1 :] == [shown, "evaluate", "runs/ppo", "--video", "runs/ppo/video.mp4"]
