"""The card of a run says what is in it, and its program loads the model."""

import re
from pathlib import Path

import pytest
import yaml

from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.runs import config as configs
from sb3_options.runs.algorithms import LOCATIONS
from sb3_options.runs.card import CARD, card_of, write_card
from sb3_options.runs.config import DQNConfig, MaskablePPOConfig
from sb3_options.runs.inspection import contents_of
from tests.runs.test_inspection import file as file

HISTORY = [EpisodeRecord(10 * (i + 1), 1.0, True, 10) for i in range(3)]


def test_a_card_names_options_numbers_and_settings(file: Path) -> None:
    config = MaskablePPOConfig(env="sb3_options/TwoRooms-v0", env_kwargs={"max_steps": 300}, n_timesteps=900, seed=3)
    write_card(file.parent, config, HISTORY, {0: 4_000, 2: 5_000})
    text = (file.parent / CARD).read_text()
    front, body = text.split("---\n")[1:]
    assert yaml.safe_load(front)["library_name"] == "stable-baselines3"
    assert "| 0 | reach 10, 5 | 10, 5 | 4,000 | 2 |" in body
    assert "| 1 | turn round | made by hand: code, not in the file | given at the start |  |" in body
    assert "| success rate, all episodes | 1 |" in body
    assert " steps, its seed 3: one run, and no study" in body
    assert contents_of(file).digest in body
    assert "subgoals.png" not in body
    (settings,) = re.findall(r"```yaml\n(.*?)```", body, re.DOTALL)
    assert yaml.safe_load(settings) == {"env_kwargs": {"max_steps": 300}, "n_timesteps": 900}


def test_settings_of_groups_are_told_where_they_differ(file: Path) -> None:
    values = {"algo": "dqn", "env": "sb3_options/TwoRooms-v0", "discovery": {"decay": 0.5}, "gamma": 0.9}
    config = configs.made(values, "here")
    text = card_of(config, [], contents_of(file), {}, picture=True)
    (settings,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert yaml.safe_load(settings) == {"gamma": 0.9, "discovery": {"decay": 0.5}}
    assert "(subgoals.png)" in text


@pytest.mark.parametrize(
    ("config", "lines"),
    [
        (
            DQNConfig(env="MiniGrid-Empty-5x5-v0"),
            ["from sb3_options.envs.minigrid import make", "env = make('MiniGrid-Empty-5x5-v0')"],
        ),
        (
            DQNConfig(env_wrapper="mine.here:Wrap", feature_map="mine:phi"),
            ["from mine.here import Wrap", "env = Wrap(env)", "from mine import phi"],
        ),
        (DQNConfig(feature_map="temporal-distance"), []),
    ],
)
def test_wrappers_are_in_the_program(config: DQNConfig, lines: list[str], file: Path) -> None:
    text = card_of(config, [], contents_of(file), {}, picture=False)
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert set(lines) <= set(program.splitlines())
    assert ("feature_map=phi" in program) == (config.feature_map == "mine:phi")
    assert ("feature_map='temporal-distance'" in program) == (config.feature_map == "temporal-distance")


def test_the_class_of_every_algorithm_can_be_imported() -> None:
    for module, name in LOCATIONS.values():
        assert isinstance(getattr(__import__(module, fromlist=[name]), name), type)
