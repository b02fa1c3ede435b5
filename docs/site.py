"""What the site needs beside Sphinx's own settings: its menu, and docstrings as this library writes them.

An extension of Sphinx, named in ``docs/conf.py``. Each function is a listener of one of Sphinx's events.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import posixpath
import re
from collections import defaultdict
from typing import Any

import jupytext
import numpy.typing as npt
from docutils import nodes
from nbformat import NotebookNode
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode
from sphinx.util.typing import stringify_annotation

CAPTIONS = {
    "": "Project",
    "docs": "Project",
    "docs/guide": "Guide",
    "docs/notebooks": "Notebooks",
    "docs/concepts": "Concepts",
    "docs/studies": "Studies",
    "docs/api": "API",
    "docs/results": "Studies",
}
"""Folder → heading of its pages in the menu."""

FACES = (
    "sb3_options",
    "sb3_options.callbacks",
    "sb3_options.discovery.methods",
    "sb3_options.envs",
    "sb3_options.envs.minigrid",
    "sb3_options.envs.pioneer",
)
"""Modules whose ``__all__`` says by which path users import a name. There alone it is described."""

LINK = re.compile(r"\]\(([^)#\s:]+\.md)\)")
ARRAY = re.compile(r"~numpy\.ndarray\[(?:~typing\.)?tuple\[[^]]*\], ~numpy\.dtype\[(.*?\]?)\]\]")
"""How Sphinx spells ``NDArray[...]``."""

ARRAY_LIKE = stringify_annotation(npt.ArrayLike, "smart")
"""How Sphinx spells ``ArrayLike``."""

ANNOTATED = re.compile(r"~?\w+\.Annotated\[([^,]+), ~?(?:pydantic\.fields\.)?FieldInfo\(.*?\]\)\]")
"""A type with bounds, as Sphinx spells it. The description of the setting gives the bounds that matter."""


def add_menu(app: Sphinx, docname: str, source: list[str]) -> None:
    """Add the menu to the home page: a hidden table of contents for each folder that the index links to.

    The index is the one list of pages. The directives are in no file, where a code host would show them as text.
    """
    if docname != app.config.root_doc:
        return
    pages = {"docs/index.md": CAPTIONS["docs"]}
    for target in LINK.findall((app.srcdir / "docs/index.md").read_text()):
        page = posixpath.normpath(posixpath.join("docs", target))
        if page == f"{docname}.md":
            continue
        folder = posixpath.dirname(page)
        if folder not in CAPTIONS:
            raise ValueError(f"CAPTIONS must say under which heading of the menu the pages of {folder!r} stand.")
        pages.pop(page, None)  # where it is linked last is its own section
        pages[page] = CAPTIONS[folder]
    for caption in dict.fromkeys(CAPTIONS.values()):
        entries = "\n".join(f"/{app.project.path2doc(page)}" for page in pages if pages[page] == caption)
        source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{entries}\n```\n"


def read_notebook(text: str) -> NotebookNode:
    """A notebook that is Markdown: every block of Python is a cell.

    Raises:
        ValueError: A block is in another language; jupytext makes it a cell with a magic, which would run it.
    """
    notebook: NotebookNode = jupytext.reads(text, fmt="md")
    languages = {notebook.metadata["jupytext"]["main_language"]}
    languages |= {cell.source.split()[0] for cell in notebook.cells if cell.source.startswith("%%")}
    if languages != {"python"}:
        raise ValueError(
            f"A notebook has blocks of Python only, got {sorted(languages)}: what is not to be run belongs on "
            "another page."
        )
    notebook.metadata["language_info"] = {"name": "python", "pygments_lexer": "python"}
    return notebook


def adapt_docstring(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Write docstrings as napoleon wants them.

    Attributes of a dataclass and of a named tuple are its arguments, so they get their types from the signature. The
    docstring of an attribute is prose: after an empty comment napoleon takes nothing before a colon for a type.
    """
    if what == "class" and (dataclasses.is_dataclass(value) or issubclass(value, tuple)):
        lines[:] = ["Args:" if line == "Attributes:" else line for line in lines]
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]


def skip_member(app: Sphinx, what: str, name: str, value: Any, skip: bool, options: Any) -> bool | None:
    """Describe each name once: no fields of named tuples, no imported names, nothing that a face shows."""
    if type(value).__name__ == "_tuplegetter":
        return True
    module = app.env.current_document.autodoc_module
    if what != "module" or module in FACES or not (inspect.isroutine(value) or isinstance(value, type)):
        return None
    imported = getattr(value, "__module__", module) != module
    shown = any(getattr(face, name, None) is value for face in _faces() if name in face.__all__)
    return True if imported or shown else None


def _faces() -> list[Any]:
    return [importlib.import_module(face) for face in FACES]


def shorten(app: Sphinx, domain: str, kind: str, content: nodes.Element) -> None:
    """Spell types as the code does, and say of no class that it is an object."""
    if content.children and content[0].astext() == "Bases: object":
        del content[0]
    for of_one in app.env.current_document.autodoc_annotations.values():
        for name, annotation in of_one.items():
            short = annotation.replace(ARRAY_LIKE, "~numpy.typing.ArrayLike")
            of_one[name] = ANNOTATED.sub(r"\1", ARRAY.sub(r"~numpy.typing.NDArray[\1]", short))


class ShortNames:
    """Where a name leads that a docstring gives without its module: `Bags`, `ways.loop_erased`."""

    def __init__(self) -> None:
        self._objects: defaultdict[str, set[tuple[str, str, str]]] = defaultdict(set)

    def resolve(
        self, app: Sphinx, env: BuildEnvironment, node: nodes.Element, content: nodes.TextElement
    ) -> nodes.reference | None:
        """The only object of this name, or the only one in the module that the name stands in."""
        if node.get("refdomain") != "py":
            return None
        if not self._objects:
            self._read(env)
        found = self._objects.get(node["reftarget"], set())
        here = {one for one in found if one[2].startswith(f"{node.get('py:module')}.")}
        for candidates in (found, here):
            if len(candidates) == 1:
                ((page, anchor, _),) = candidates
                return make_refnode(app.builder, node["refdoc"], page, anchor, content)
        return None

    def _read(self, env: BuildEnvironment) -> None:
        for name, found in env.get_domain("py").objects.items():  # type: ignore[attr-defined]  # of the Python domain
            if not found.aliased:
                parts = name.split(".")
                for i in range(1, len(parts)):
                    self._objects[".".join(parts[i:])].add((found.docname, found.node_id, name))


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the listeners."""
    app.connect("source-read", add_menu)
    app.connect("autodoc-process-docstring", adapt_docstring, priority=400)  # before napoleon
    app.connect("autodoc-skip-member", skip_member)
    app.connect("object-description-transform", shorten, priority=400)  # before autodoc
    app.connect("missing-reference", ShortNames().resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
