"""A wheel, installed where there is no checkout: the console script trains, evaluates, compares and shows options."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import processes

ROOT = Path(__file__).parents[2]
SHORT = "--n-timesteps 600 --env-kwargs max_steps:50 --no-progress --max-options 2 --checkpoint-freq 0"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which the wheel was installed, without what it depends on."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"  # setuptools builds in the folder it reads, where a second process may build, too
    for package in ("sb3_options", "envs", "callbacks"):
        shutil.copytree(ROOT / package, source / package, symlinks=True)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    wheel = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(source)]
    subprocess.run(wheel, check=True, cwd=folder)
    (file,) = folder.glob("*.whl")
    target = folder / "site"
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", str(target), str(file)], check=True)
    return target


@pytest.mark.slow
@pytest.mark.xdist_group("wheel")  # one build for both
def test_from_a_wheel_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    environment = {"PYTHONPATH": str(installed), "COLUMNS": "120", "NO_COLOR": "1", "OMP_NUM_THREADS": "1"}

    def run(*words: str) -> str:
        done = processes.python(str(installed / "bin" / "sb3-options"), *words, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    where = "import sb3_options, sb3_options.envs, sb3_options.callbacks as c; print(sb3_options.__file__, c.__file__)"
    done = processes.python("-c", where, cwd=tmp_path, env=environment)
    assert all(Path(file).is_relative_to(installed) for file in done.stdout.split()), done.stdout + done.stderr
    for seed in ("0", "1"):
        said = run("train", "ppo", "--seed", seed, *SHORT.split())
        assert "sb3-options evaluate runs/ppo" in said.replace("\n", " ")
    first, second = sorted((tmp_path / "runs" / "ppo").iterdir())
    assert "success rate" in run("evaluate", str(first), "--episodes", "2")
    assert "0 of 2 slots are taken" in run("options", str(first))
    compared = run("compare", str(first), str(second), "--reach", "return=0.5")
    assert "primitive steps to return ≥ 0.5" in compared
    assert [cell.strip() for cell in compared.splitlines()[3].split("│")[1:-1]] == ["runs", "2"]  # one group
    assert (tmp_path / "compare.png").stat().st_size > 10_000


def test_a_missing_extra_is_named(tmp_path: Path) -> None:
    code = "import sys; sys.modules['rich'] = None; from sb3_options.__main__ import main; main()"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "pip install 'sb3-options[train,contrib]' (in a checkout '.[train,contrib]')" in done.stderr
    assert "Traceback" not in done.stderr
