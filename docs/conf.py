"""Settings of the documentation's site: ``make docs`` builds it into ``out/docs/html``.

The source folder is the root of the repository, so that README, changelog and docs are one site from the files that a
code host shows, and a relative link means the same in both.
"""

from sb3_options import __version__

project = "sb3-options"
author = "The sb3-options developers"
copyright = author
version = release = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "docs.site"]
root_doc = "README"
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**"]
exclude_patterns = [".*", "benchmarks", "build", "envs", "callbacks", "examples", "experiments", "mutants", "out"]
exclude_patterns += [
    "runs",
    "sb3_options",
    "tests",
    "docs/package.md",
]  # without them Sphinx would look for pages everywhere
nitpicky = True
nitpick_ignore_regex = [
    (r"py:obj", r"ConfigDict"),  # of pydantic
    # Other libraries: without their inventories, which would have to be fetched, there is nothing to link to.
    (
        "py:.*",
        r"(abc|collections|dataclasses|enum|gym|gymnasium|matplotlib|nn|np|npt|numpy|os|pathlib|pydantic|sb3_contrib|scipy"
        r"|spaces|stable_baselines3|torch|types|typing)\..*",
    ),
    ("py:.*", r"ArrayLike|BaseAlgorithm|BaseCallback|EnvFns|GymEnv|MaybeCallback|ReplayBufferSamples|Tensor|VecEnv"),
    ("py:.*", r"(Float|Int|Bool)Array|sb3_options\..*\.(M|Model|Result)"),  # arrays, type variables
    ("py:class", r"'.*'|Deposit|ObservationKind|RenderMode"),  # the descriptions of the arguments name the choices
    ("py:obj", r"[a-z_]\w*"),  # an argument or an attribute, of which its class tells
]

# Markdown
source_suffix = {".nb.md": "myst-nb", ".md": "myst-nb"}
myst_heading_anchors = 6
highlight_language = "none"

# Notebooks are Markdown as jupytext reads it: a block of Python is a cell. They hold no outputs. A build runs them, and
# keeps no cache, which would not notice that the library has changed.
nb_custom_formats = {".nb.md": "docs.site.read_notebook"}
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_show_tb = True
nb_execution_timeout = 600  # s, for a loaded machine

# API reference
default_role = "py:obj"
add_module_names = False
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
python_display_short_literal_types = True
maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# HTML
html_theme = "furo"
html_title = "sb3-options"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_additional_pages = {"index": "to_start.html"}
templates_path = ["templates"]
