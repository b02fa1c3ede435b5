"""The documentation's site: what `make docs` builds."""

import html
import re
from pathlib import Path

import pytest
from sphinx.util.inventory import InventoryFile

import sb3_options
from docs import site
from sb3_options import callbacks, discovery, envs
from tests.support import processes
from tests.support.documents import PAGES, ROOT, name_of, python_of, text_of

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.md"))


class Built:
    """A built site."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def text(self, page: str) -> str:
        return (self.folder / f"{page}.html").read_text(encoding="utf-8")

    def words(self, page: str) -> str:
        return html.unescape(re.sub(r"<[^>]+>", "", self.text(page)))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """Built with its notebooks, by the command of the Makefile."""
    folder = tmp_path_factory.mktemp("site")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (arguments,) = re.findall(r"-m sphinx (.*) out/docs/html \$\(ARGS\)$", makefile, flags=re.MULTILINE)
    command = ("-m", "sphinx", *arguments.split(), str(folder / "docs" / "html"))
    result = processes.python(*command, cwd=ROOT, env={"IPYTHONDIR": str(folder / "ipython")})
    assert result.returncode == 0, result.stderr[-5_000:]
    return Built(folder / "docs" / "html")


def documented(folder: Path) -> set[str]:
    """The names that have an entry in the API reference."""
    inventory = InventoryFile.loads((folder / "objects.inv").read_bytes(), uri="")
    return {name for kind, of_kind in inventory.data.items() if kind.startswith("py:") for name in of_kind}


@pytest.mark.slow
def test_every_page_is_on_the_site(built: Built) -> None:
    for page in PAGES:
        name = name_of(page).removesuffix(".md").removesuffix(".nb")
        title = re.search(r"^# (.*)$", text_of(page), flags=re.MULTILINE)
        assert title
        assert re.sub(r"[`’']", "", title[1]) in re.sub(r"[`’']", "", built.words(name)), name
    assert 'url=docs/index.html"' in built.text("index")


@pytest.mark.slow
def test_the_index_has_the_menu_and_no_directive(built: Built) -> None:
    menu = built.text("docs/index").partition('class="sidebar-tree"')[2].partition("</aside>")[0]
    assert re.findall(r'"caption-text">(.*?)<', menu) == list(dict.fromkeys(site.CAPTIONS.values()))
    assert menu.index("Experience") < menu.index("Checkpoints") < menu.index("Runs")
    assert "toctree" not in built.words("docs/index")
    assert "toctree" not in text_of(ROOT / "docs" / "index.md")


@pytest.mark.slow
def test_links_and_pictures_are_carried_over(built: Built) -> None:
    guide = built.text("docs/guide/quickstart")
    assert 'href="../studies/first-hour.html#two-rooms"' in guide
    assert (built.folder / "_images" / "multiroom.gif").is_file()
    assert list((built.folder / "_downloads").rglob("paper.json"))
    assert 'href="CONTRIBUTING.html"' in built.text("README") or 'href="docs/index.html"' in built.text("README")


@pytest.mark.slow
def test_all_that_is_exported_is_in_the_reference(built: Built) -> None:
    names = documented(built.folder)
    for face in (sb3_options, callbacks, discovery, envs):
        for name in face.__all__:
            if isinstance(getattr(face, name), type) or callable(getattr(face, name)):
                assert f"{face.__name__}.{name}" in names, name
    rows = re.findall(r"^\| `(\w+)` \| .* \| `([\w.]+)` \|$", text_of(ROOT / "docs/concepts/index.md"), re.MULTILINE)
    last = {name.rpartition(".")[2] for name in names}
    assert {name for name, module in rows if not module.startswith("runs.")} <= last


@pytest.mark.slow
def test_an_entry_says_arguments_types_and_errors(built: Built) -> None:
    words = built.words("docs/api/callbacks")
    entry = words.partition("class SubgoalDiscoveryCallback")[2].partition("class ")[0]
    assert "max_new_options (int | None) – Most options to make" in entry
    assert "ValueError – A setting is out of its range" in entry
    settings = built.words("docs/api/discovery").partition("class DiscoverySettings")[2]
    assert "decay (float) – λ of the running averages" in settings  # of a dataclass, whose type has bounds
    for page in ("callbacks", "discovery", "density", "learning"):
        assert "FieldInfo" not in built.words(f"docs/api/{page}")
        assert "_SupportsArray" not in built.words(f"docs/api/{page}")
        assert "Bases: object" not in built.words(f"docs/api/{page}")


@pytest.mark.slow
@pytest.mark.parametrize("page", NOTEBOOKS, ids=lambda page: page.name)
def test_a_notebook_shows_what_it_printed_and_drew(page: Path, built: Built) -> None:
    name = name_of(page).removesuffix(".nb.md")
    text = built.text(name)
    cells = python_of(page)
    assert text.count('class="cell_input') == len(cells)
    drawn = sum("subplots" in code or "draw(" in code or "fig\n" in code for code in cells)
    assert text.count('src="../../_images/') >= drawn - 1  # one cell may only define how to draw
    assert "the subgoal; " in built.words(name)  # printed of the option's runs


def test_every_block_of_python_is_a_cell() -> None:
    assert len(NOTEBOOKS) == 2
    for page in NOTEBOOKS:
        assert page.name.endswith(".nb.md"), "other names are no notebooks for docs/conf.py"
        cells = [cell.source for cell in site.read_notebook(text_of(page)).cells if cell.cell_type == "code"]
        assert cells == [code.strip() for code in python_of(page)]


@pytest.mark.parametrize(("python", "got"), [("```python\n1\n```\n\n", "'%%bash', 'python'"), ("", "'bash'")])
def test_a_notebook_with_commands_is_refused(python: str, got: str) -> None:
    with pytest.raises(ValueError, match=rf"blocks of Python only, got \[{got}\]: what is not to be run belongs"):
        site.read_notebook(f"# Title\n\n{python}```bash\nrm file\n```\n")
