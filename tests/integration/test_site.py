"""The documentation's site: what `make docs` builds."""

import html
import re
from pathlib import Path

import pytest
from sphinx.util.inventory import InventoryFile

import sb3_options
from sb3_options import callbacks, envs
from tests.support import processes
from tests.support.documents import PACKAGE, PAGES, ROOT, name_of, python_of, text_of

pytestmark = pytest.mark.xdist_group("site")  # one build for all

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
    for page in (page for page in PAGES if page != PACKAGE):
        name = name_of(page).removesuffix(".md").removesuffix(".nb")
        title = re.search(r"^# (.*)$", text_of(page), flags=re.MULTILINE)
        assert title
        assert re.sub(r"[`’']", "", title[1]) in re.sub(r"[`’']", "", built.words(name)), name
    assert 'url=README.html"' in built.text("index")


@pytest.mark.slow
def test_all_that_is_exported_is_in_the_reference(built: Built) -> None:
    names = documented(built.folder)
    for face in (sb3_options, callbacks, envs):
        for name in face.__all__:
            if isinstance(getattr(face, name), type) or callable(getattr(face, name)):
                assert f"{face.__name__}.{name}" in names, name
    rows = re.findall(r"^\| `(\w+)` \| .* \| `([\w.]+)` \|$", text_of(ROOT / "docs/concepts/index.md"), re.MULTILINE)
    last = {name.rpartition(".")[2] for name in names}
    assert {name for name, module in rows if not module.startswith("runs.")} <= last


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
