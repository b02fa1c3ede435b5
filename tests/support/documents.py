"""The documents as tests read them: pages, their Python, their commands, their links."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PACKAGE = ROOT / "docs" / "package.md"  # what a package index shows, and no page of the site

PAGES = (README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md")))

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
SHORTER = re.compile(r"(learn\(|n_timesteps=|n_trials=)[\d_]+(.*)  # tested with ([\d_]+)$", re.MULTILINE)
"""A line that trains for long, and says for how many steps tests do."""


class Link(NamedTuple):
    """Where a link of a page leads."""

    page: Path
    target: str

    @property
    def path(self) -> Path:
        """The file or folder."""
        name = self.target.partition("#")[0]
        return (self.page.parent / name).resolve() if name else self.page

    @property
    def anchor(self) -> str:
        """The heading, as GitHub spells it in an address; empty for none."""
        return self.target.partition("#")[2]


def name_of(page: Path) -> str:
    """Its path from the root."""
    return page.relative_to(ROOT).as_posix()


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def prose_of(page: Path) -> str:
    """The text without blocks of code."""
    return FENCE.sub("", text_of(page))


def python_of(page: Path, marked: str = "python") -> list[str]:
    """The blocks of Python as they stand in a page; ``py`` marks what needs a package that tests may lack."""
    return [code for language, code in FENCE.findall(text_of(page)) if language == marked]


def program_of(page: Path) -> str:
    """The Python of a page, its training shortened; every line stands where it stands in the page, for tracebacks."""
    lines = [""] * text_of(page).count("\n")
    for block in FENCE.finditer(text_of(page)):
        if block[1] == "python":
            first = text_of(page)[: block.start(2)].count("\n")
            code = SHORTER.sub(r"\g<1>\g<3>\g<2>", block[2]).splitlines()
            lines[first : first + len(code)] = code
    return "\n".join(lines)


def commands_of(page: Path) -> Iterator[str]:
    """What a page tells to run in a shell: lines of blocks, without their comments, and code within sentences."""
    for language, code in FENCE.findall(text_of(page)):
        if language == "bash":
            yield from (line.partition("  #")[0].strip() for line in code.splitlines())
    yield from re.findall(r"`([^`\n]+)`", prose_of(page))


def links_of(page: Path) -> list[Link]:
    """Links and pictures that lead to files of the repository."""
    targets = re.findall(r"\]\(([^)\s]+)\)", prose_of(page))
    return [Link(page, target) for target in targets if "://" not in target]


def anchors_of(page: Path) -> set[str]:
    """The headings of a page as GitHub spells them in addresses."""
    headings = re.findall(r"^#+ (.*)$", prose_of(page), flags=re.MULTILINE)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}
