"""What the README shows, run."""

import re
from pathlib import Path
from typing import Any

import pytest

from tests.support import processes

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_readme_fits_on_one_screen() -> None:
    assert len(README.splitlines()) <= 60


def test_every_file_that_readme_names_is_there() -> None:
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert links
    for link in links:
        assert (ROOT / link).exists(), link


@pytest.mark.parametrize(
    "document",
    ["README.md", "docs/how-it-works.md", "docs/concepts/density.md", "docs/studies/discovery.md", "CONTRIBUTING.md"],
)
def test_every_module_that_documents_run_is_there(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    for module in re.findall(r"python -m ((?:experiments|benchmarks)\.\w+)", text):
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module


def test_make_targets_of_readme_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.findall(r"^make (\w+)", README, flags=re.MULTILINE)
    assert targets == ["train", "test"]
    for target in targets:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE)


def test_examples_of_diverse_density_run() -> None:
    text = (ROOT / "docs/concepts/density.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(examples) == 2
    for code in examples:
        exec(code, {"__name__": "example"})


def test_example_of_a_trained_model_runs_but_shorter() -> None:
    text = (ROOT / "docs/how-it-works.md").read_text(encoding="utf-8")
    (code,) = [c for c in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL) if "expand_action_space" in c]
    shorter = code.replace("20_000", "200").replace("30_000", "300")
    scope: dict[str, Any] = {"__name__": "example"}
    exec(shorter, scope)
    assert scope["model"].num_timesteps == 500
    assert scope["model"].action_space.n == 8


@pytest.mark.slow
def test_drop_in_runs_as_pasted_but_shorter(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    shorter = code.replace("50_000", "1_500")
    assert shorter != code
    strict = "import warnings; warnings.simplefilter('error', UserWarning)\n"
    result = processes.python("-c", strict + shorter, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert list(tmp_path.glob("runs/DQN_1/events*"))
