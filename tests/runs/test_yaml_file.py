"""Numbers as people write them, by YAML 1.2, not 1.1."""

from pathlib import Path
from typing import Any

import pytest

from sb3_options.runs.config import load
from sb3_options.runs.yaml_file import dump, parse


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e4", 1e4),
        ("3e-4", 3e-4),
        ("-2.5E+3", -2500.0),
        ("1_0e2", 1000.0),
        ("1.e3", 1000.0),
        ("12", 12),
        ("0.5", 0.5),
        ("e4", "e4"),
        ("1e4 steps", "1e4 steps"),
        ("'1e4'", "1e4"),
        ("1e", "1e"),
        ("v1e4", "v1e4"),
    ],
)
def test_numbers_with_an_exponent_are_numbers(text: str, value: Any) -> None:
    read = parse(text)
    assert read == value
    assert type(read) is type(value)


def test_a_text_stays_a_text() -> None:
    content = {"text": "1e4", "number": 1e22, "tiny": 1e-07}
    assert parse(dump(content)) == content


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed: 1\ngamma: 0.9\nseed: 2\n", "it has 'seed' twice; give it once."),
        ("n_envs: 1\nn-envs: 2\n", "it has 'n_envs' twice; give it once."),
        ("discovery:\n  decay: 0.5\n  decay: 0.6\n", "it has 'decay' twice; give it once."),
        ("env_kwargs: {goal: 1, goal: 2}\n", "it has 'goal' twice; give it once."),
    ],
)
def test_a_name_that_is_there_twice_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "run.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"run\.yaml is no YAML that can be read safely: ") as error:
        load(tmp_path / "run.yaml")
    assert str(error.value).endswith(said)


def test_a_name_may_be_there_once_in_each_part() -> None:
    read = parse("a: {decay: 1}\nb: {decay: 2}\n1: x\n'1': y\n")
    assert read == {"a": {"decay": 1}, "b": {"decay": 2}, 1: "x", "1": "y"}
