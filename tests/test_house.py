"""What CONTRIBUTING promises of the files themselves: packaged folders, short paragraphs, a picture that is current."""

import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import sb3_options
from docs import architecture

ROOT = Path(__file__).parents[1]
TOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
MAX_WORDS = 120
TO_REWRITE: set[str] = set()
"""Documents with paragraphs that are still too long. A document that has none leaves this set."""


def modules() -> list[Path]:
    """Every module of the library, each once."""
    return sorted(path for folder in ("sb3_options", "callbacks", "envs") for path in (ROOT / folder).rglob("*.py"))


def documents() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def paragraphs(text: str) -> Iterator[str]:
    """Paragraphs of Markdown, each item of a list by itself; no code, tables or headings."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*+]|\d+\.)\s)", text):
        if not block.lstrip().startswith(("|", "#")):
            yield block


def test_paragraphs_are_told_apart() -> None:
    text = "# Long heading\n\nOne two\nthree.\n- four five\n- six\n\n```\ncode\n\ncode\n```\n| a | table |\n\nseven"
    assert [p.split() for p in paragraphs(text) if p.split()] == [
        ["One", "two", "three."],
        ["-", "four", "five"],
        ["-", "six"],
        ["seven"],
    ]


@pytest.mark.parametrize("path", documents(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_paragraphs_are_short(path: Path) -> None:
    long = [p for p in paragraphs(path.read_text(encoding="utf-8")) if len(p.split()) > MAX_WORDS]
    if path.relative_to(ROOT).as_posix() in TO_REWRITE:
        assert long, f"{path.name} has no paragraph of more than {MAX_WORDS} words any more: take it off TO_REWRITE"
    else:
        assert not long, f"{len(long[0].split())} words: {long[0].strip()[:80]} …"


def test_every_folder_is_packaged() -> None:
    packages = TOOLS["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT) for path in modules()}
    assert {".".join(dict.fromkeys(("sb3_options", *folder.parts))) for folder in folders} == set(packages)
    assert all((ROOT / folder / "__init__.py").is_file() for folder in folders)


def test_the_version_is_said_once() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "version" not in project
    assert TOOLS["setuptools"]["dynamic"]["version"] == {"attr": "sb3_options.__version__"}
    released = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")[1]
    assert released.startswith(sb3_options.__version__.removesuffix(".dev0"))


def test_training_needs_no_tools_of_development() -> None:
    rules = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "train: $(TRAINS)" in rules
    assert "--editable '.[train,contrib]'\n\ttouch $(TRAINS)" in rules


def test_the_picture_of_the_folders_is_up_to_date() -> None:
    assert architecture.shown() == architecture.read().text(), "run `make architecture` and look at the picture"


def test_the_picture_shows_which_folders_are_pure() -> None:
    (pure,) = [c["source_modules"] for c in TOOLS["importlinter"]["contracts"] if "gymnasium" in str(c)]
    green = {name for name, place in architecture.PLACES.items() if place.colour == architecture.GREEN}
    assert {f"sb3_options.{name}" for name in green} == set(pure)


def test_a_folder_without_a_place_is_named() -> None:
    content = architecture.read()
    content.modules["attic"] = []
    with pytest.raises(ValueError, match=r"PLACES must say where \['attic'\] stand: add their column and floor"):
        architecture.draw(content)


def test_every_promise_has_its_test() -> None:
    page = (ROOT / "docs" / "promises.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w/]+\.py)::(\w+)`", page)
    assert len(named) > 100
    missing = [
        f"{path}::{name}"
        for path, name in named
        if not (ROOT / "tests" / path).is_file()
        or not re.search(rf"^ *def {name}\(", (ROOT / "tests" / path).read_text(encoding="utf-8"), re.MULTILINE)
    ]
    assert not missing, "docs/promises.md names these tests: name another one there, or withdraw the promise"


def test_public_names_import_nothing_slow() -> None:
    """Beside Stable-Baselines3, which imports matplotlib and pandas itself."""
    code = "from sb3_options import *; import sys; print(*{'scipy', 'optuna'} & set(sys.modules))"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.split() == []
