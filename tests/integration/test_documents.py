"""What README and docs show, run: their Python, their commands, their links, their numbers."""

import importlib
import os
import re
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path

import mypy.api
import pytest
import tyro

from experiments.deep import report as deep_report
from experiments.paper import report as paper_report
from experiments.pioneer import report as pioneer_report
from sb3_options.cli import COMMANDS, parse, parse_command
from tests.support import processes
from tests.support.documents import (
    PACKAGE,
    PAGES,
    README,
    ROOT,
    anchors_of,
    commands_of,
    links_of,
    name_of,
    program_of,
    python_of,
    text_of,
)

STUDIES = ROOT / "docs" / "studies"
RESULTS = ROOT / "docs" / "results"

GUIDING = [page for page in PAGES if page.name != "CHANGELOG.md"]
"""Pages of the present; the changelog also names what was."""

PYTHON = [page for page in PAGES if python_of(page) and not page.name.endswith(".nb.md")]
"""Pages that show Python. Notebooks are run whole, by test_site.py."""

CHECKS = {
    "README.md": "from pathlib import Path; assert list(Path('runs/MaskablePPO_1').glob('events*'))",
    "docs/guide/options-files.md": "assert slot == 0; assert info['option']['index'] == slot",
    "docs/guide/tracking.md": """
from pathlib import Path
(kept,) = Path("wandb").glob("offline-run-*/*.wandb")
assert b"search/leading_average" in kept.read_bytes()
(of_mlflow,) = mlflow.search_runs(output_format="list")
assert of_mlflow.data.metrics["time/primitive_steps"] >= 1_500
assert of_mlflow.data.params["algo"] == "DQN"
""",
    "docs/guide/trained-models.md": "assert (model.num_timesteps, model.action_space.n) == (500, 8)",
    "docs/guide/your-environment.md": """
buffer = model.replay_buffer
stored = buffer.actions[: buffer.size(), 0]
np.testing.assert_allclose(buffer.discounts[: buffer.size()], np.where(stored == 1, 0.99**8, 0.99), rtol=1e-6)
assert model.num_timesteps >= 2000 > buffer.size()  # a crossing by ferry is one transition of 8
""",
}
"""What must hold after the Python of a page has run."""

MOST_STEPS = 5_000
"""Longest training that a page may show without saying how long tests train."""


SLOW = ("docs/guide/many-environments.md", "docs/guide/tracking.md")
"""Pages whose Python starts third-party servers: Ray, Weights & Biases, MLflow."""


def named(pages: Sequence[Path]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("page", pages, ids=name_of)


def ran(code: str, folder: Path) -> str:
    """What a program prints in a new process."""
    result = processes.python("-c", code, cwd=folder)
    assert result.returncode == 0, result.stderr
    return result.stdout


def until_found(program: str, steps: str, enough: str) -> str:
    """A program that trains only until it has discovered what it shows."""
    assert f"learn({steps}" in program
    return program.replace(f"learn({steps}", f"learn({enough}")


def test_readme_fits_on_one_screen() -> None:
    assert len(text_of(README).splitlines()) <= 60


@pytest.mark.parametrize(
    "page",
    [pytest.param(each, marks=[pytest.mark.slow] * (name_of(each) in SLOW), id=name_of(each)) for each in PYTHON],
)
def test_python_runs_as_pasted_but_shorter(page: Path, tmp_path: Path) -> None:
    program = program_of(page)
    steps = [int(n) for n in re.findall(r"learn\(([\d_]+)", program)]
    assert max(steps, default=0) <= MOST_STEPS, "end the line with `# tested with N`"
    strict = "import warnings; warnings.simplefilter('error', UserWarning)"  # in the place of the title
    ran(f"{strict}{program}\n{CHECKS.get(name_of(page), '')}", tmp_path)


@pytest.mark.slow
def test_an_option_by_hand_is_one_to_mypy_too(tmp_path: Path) -> None:
    """Its three functions take what this environment observes, not anything that an environment may observe."""
    page = ROOT / "docs/guide/options-files.md"
    end = text_of(page).splitlines().index("## Other options between trainings")
    program = tmp_path / "by_hand.py"
    program.write_text("\n".join(program_of(page).splitlines()[:end]), encoding="utf-8")
    assert "lambda xy:" in program.read_text(encoding="utf-8")
    options = ["--config-file", os.devnull, "--ignore-missing-imports", "--cache-dir", str(tmp_path / "cache")]
    said, errors, status = mypy.api.run([*options, str(program)])
    assert status == 0, said + errors


@pytest.mark.slow
def test_the_program_of_the_readme_discovers_the_doorway(tmp_path: Path) -> None:
    """As pasted, its first task until there is an option; with a seed and one thread, which it has not."""
    (program,) = python_of(README)
    first, learn, second = program.rpartition("model.learn(50_000")
    assert "model.learn(50_000" in first
    shorter = until_found(first, "50_000", "12_000") + learn.replace("50_000", "600") + second
    seeded = shorter.replace('"n_steps": 512', '"n_steps": 512, "seed": 0')
    assert '"seed": 0' in seeded
    said = ran(f"import torch; torch.set_num_threads(1)\n{seeded}", tmp_path)
    where = re.search(r"^Option 0: reach (\d+), (\d+), after", said)
    assert where is not None, said
    assert abs(int(where[1]) - 10) + abs(int(where[2]) - 5) <= 1


@pytest.mark.slow
def test_the_taxi_discovers_its_passenger(tmp_path: Path) -> None:
    first, taxi, *_ = python_of(ROOT / "docs/guide/concept-features.md")
    imports_and_settings = first.partition("env =")[0]
    taxi = until_found(taxi, "60_000", "12_000")
    check = "assert 'passenger at 1, 0, 0' in [found.where for found in callback.discoveries]"
    ran(f"{imports_and_settings}{taxi}\n{check}", tmp_path)


@pytest.mark.slow
def test_the_example_of_an_environment_discovers_its_gate(tmp_path: Path) -> None:
    (example,) = (code for code in python_of(ROOT / "docs/guide/your-environment.md") if "Warehouse" in code)
    check = "assert np.abs(callback.discoveries[0].subgoal - [6, 3]).max() <= 2"
    ran(f"{until_found(example, '30_000', '6_000')}\n{check}", tmp_path)


def test_what_a_package_index_shows_leads_nowhere_else() -> None:
    assert f'readme = "{PACKAGE.relative_to(ROOT)}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert not list(links_of(PACKAGE))


@named(PAGES)
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in links_of(page):
        assert link.path.exists(), link.target
        assert not link.anchor or link.anchor in anchors_of(link.path), link.target


def test_every_page_is_a_few_clicks_from_the_readme() -> None:
    clicks = {README: 0}
    for page in (queue := [README]):
        for link in links_of(page):
            if link.path.suffix == ".md" and link.path not in clicks:
                clicks[link.path] = clicks[page] + 1
                queue.append(link.path)
    assert {page for page in PAGES if page.is_relative_to(ROOT / "docs")} - {PACKAGE} <= set(clicks)
    assert clicks[ROOT / "docs" / "guide" / "your-environment.md"] == 1
    assert max(clicks.values()) <= 2


def test_every_picture_is_shown() -> None:
    shown = {link.path for page in PAGES for link in links_of(page)}
    assert set((ROOT / "docs" / "images").rglob("*.*")) <= shown


@named(GUIDING)
def test_commands_of_train_are_understood(page: Path) -> None:
    for command in commands_of(page):
        program, _, arguments = command.removeprefix("python ").partition(" ")
        words = shlex.split(re.sub(r"--config \S+", "", arguments))  # there is no such file
        if program not in ("train.py", "sb3-options") or (len(words) == 1 and words[0] in COMMANDS):
            continue
        if words[:1] == ["train"]:
            words = words[1:]
        if words and words[0] in COMMANDS:
            parse_command(words[0], words[1:])
        elif "--help" in words:
            with pytest.raises(SystemExit, match=r"^0$"):
                parse(words)
        else:
            parse(words)


@named(GUIDING)
def test_commands_of_studies_are_understood(page: Path) -> None:
    for command in commands_of(page):
        found = re.fullmatch(r"python -m ((?:experiments|benchmarks)\.[\w.]+)(.*)", command)
        if not found:
            continue
        package = ROOT / found[1].replace(".", "/")
        module = importlib.import_module(f"{found[1]}.__main__" if package.is_dir() else found[1])
        flags = next(vars(module)[name] for name in ("Study", "Benchmark", "Tuning", "Ratios") if name in vars(module))
        words = [word.split("|")[-1] for word in shlex.split(found[2])]
        if words:
            tyro.cli(flags, args=words if "--out" in words else [*words, "--out", "FOLDER"])


def test_make_targets_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = {command.split()[1] for page in PAGES for command in commands_of(page) if command.startswith("make ")}
    assert targets >= {"train", "test", "check", "paper", "docs", "architecture"}
    for target in targets:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_every_abstraction_is_where_the_page_says() -> None:
    rows = re.findall(r"^\| `(\w+)` \| .* \| `([\w.]+)` \|$", text_of(ROOT / "docs/concepts/index.md"), re.MULTILINE)
    assert len(rows) > 50
    for name, module in rows:
        assert hasattr(importlib.import_module(f"sb3_options.{module}"), name), f"{name} in {module}"


def test_numbers_of_studies_are_those_of_their_results(tmp_path: Path) -> None:
    pages = {name: Path(shutil.copy(STUDIES / f"{name}.md", tmp_path)) for name in ("paper", "pioneer", "deep")}
    paper_report.main(paper_report.Report(RESULTS / "paper.json", pages["paper"]))
    pioneer, benchmark, twin = (RESULTS / f"{n}.json" for n in ("pioneer", "pioneer_benchmark", "pioneer-twin"))
    pioneer_report.main(pioneer_report.Report(pioneer, benchmark, twin, pages["pioneer"]))
    deep = ("transfer-ppo", "transfer-dqn", "same-ppo", "same-dqn", "transfer-ppo-control", "same-ppo-control")
    deep_report.main(deep_report.Report(tuple(RESULTS / f"deep-{name}.json" for name in deep), pages["deep"]))
    for name, page in pages.items():
        assert text_of(page) == text_of(STUDIES / f"{name}.md"), f"{name}.md: fill it in again by its report"
