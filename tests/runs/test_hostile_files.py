"""Configurations from strangers: none runs, imports or writes anything, and each gets one clear line."""

import sys
import time
from pathlib import Path

import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.cli import parse
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import yaml_file
from tests.support.processes import HANGING
from tests.support.runs import Refused

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 9)}]\n" for i in range(12)
)

HOSTILE = {
    "a tag that calls": ("seed: !!python/object/apply:os.mkdir ['{trace}']\n", "has the tag or anchor"),
    "a tag that makes an object": ("seed: !!python/object:os.system {{}}\n", "has the tag or anchor"),
    "a tag that names a module": ("env: !!python/module:evil_module\n", "has the tag or anchor"),
    "an alias bomb": (BOMB.replace("{", "{{").replace("}", "}}"), "has the tag or anchor 'a'"),
    "a value within itself": ("env_kwargs: &a\n  a: *a\n", "has the tag or anchor 'a'"),
    "deep lists": ("net_arch: " + "[" * 20_000 + "\n", "has more than 20 levels"),
    "deep mappings": ("env_kwargs: " + "{{a: " * 9_000 + "\n", "has more than 20 levels"),
    "a long file": ("# " + "x" * 200_000 + "\n", "has more than 100,000 characters"),
    "many settings": ("".join(f"a{i}: 1\n" for i in range(9_000)), "there is no setting 'a0'"),
    "one setting many times": ("a: 1\n" * 15_000, "it has 'a' twice; give it once."),
    "many digits": ("seed: " + "9" * 5_000 + "\n", "is no YAML that can be read safely"),
    "a date that is none": ("seed: 2020-13-45\n", "is no YAML that can be read safely"),
    "two documents": ("seed: 1\n---\nseed: 2\n", "is no YAML that can be read safely"),
    "an open bracket": ("seed: [1\n", "is no YAML that can be read safely"),
    "a list": ("- 1\n- 2\n", "must hold `name: value` lines, got a list"),
    "flags in a list": ("net_arch: [--help]\n", "net_arch.0 should be"),
    "flags in env_kwargs": ("env_kwargs: [--help]\n", "env_kwargs should be a valid dictionary"),
    "help as a value": ("seed: --help\n", "seed should be a valid integer"),
    "another file": ("config: other.yml\n", "there is no setting 'config'"),
    "an environment's module": ("env: evil_module:Env-v0\n", "would import a module"),
    "an old one": ("env: GymV26Environment-v0\nenv_kwargs: {{env_id: 'evil_module:E-v0'}}\n", "would import a module"),
    "a module in a list": ("env: ['evil_module:Env-v0']\n", "would import a module"),
    "a module as algorithm": ("algo: evil_module\n", "There is no algorithm 'evil_module'"),
    "a list as algorithm": ("algo: [ppo]\n", "There is no algorithm"),
    "a number as key": ("1: 2\n", "there is no setting '1'"),
    "a class as setting": ("__class__: evil_module\n", "there is no setting '__class__'"),
    "another environment's id": ("env_kwargs: {{id: 'evil_module:Env-v0'}}\n", "'id'"),
    "an environment's entry point": ("env_kwargs: {{entry_point: 'evil_module:Env'}}\n", "'entry_point'"),
    "NaN as a share": ("gamma: .nan\n", "gamma should be"),
    "infinity as a rate": ("learning_rate: .inf\n", "learning_rate"),
    "more environments than there are": ("n_envs: 100000000\n", "n_envs should be"),
    "more slots than there can be": ("max_options: 1000000000000000000\n", "max_options"),
    "a seed beyond NumPy's": ("seed: 4294967296\n", "seed should be"),
    "a negative size": ("net_arch: [-1]\n", "net_arch.0 should be"),
    "a null character in a path": ('options: "a\\0b"\n', "Error: "),
    "a device as a flag": ("algo: dqn\ndevice: --help\n", "device"),
}


@pytest.fixture
def trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What must not be there afterwards; and a module whose import leaves it."""
    (tmp_path / "evil_module.py").write_text(f"import os\nos.mkdir({str(tmp_path / 'ran')!r})\n")
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / "ran"


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("how", ["--config", "evaluate"])
def test_is_refused_in_one_line(name: str, how: str, trace: Path, tmp_path: Path, refused: Refused) -> None:
    text, expected = HOSTILE[name]
    run = tmp_path / "run"
    run.mkdir()
    (run / runs.CONFIG).write_text(text.format(trace=trace))
    (run / runs.MODEL).touch()
    (run / runs.OPTIONS).touch()
    before, began = files(tmp_path), time.monotonic()
    args = ["--config", str(run / runs.CONFIG), "--no-progress", "--tensorboard-log", str(tmp_path / "runs")]
    assert expected in refused(*(["evaluate", str(run)] if how == "evaluate" else args), codes=[1, 2])
    assert time.monotonic() - began < HANGING  # a bomb would take hours
    assert "evil_module" not in sys.modules
    assert not trace.exists()
    assert files(tmp_path) == before


def test_the_command_line_itself_may_name_a_module(tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text("env: evil_module:Env-v0\nseed: 3\n")
    config = parse(["--config", str(tmp_path / "config.yml"), "--env", "my_module:Env-v0"])
    assert (config.env, config.seed) == ("my_module:Env-v0", 3)
    assert configs.load(tmp_path / "config.yml", {"env": "my_module:Env-v0"}) == config


def test_files_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ValueError, match=r"config\.yml is no YAML that can be read safely"):
        yaml_file.read_mapping(tmp_path / "config.yml")
