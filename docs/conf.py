"""How Sphinx builds the site: `make docs`.

Everything is read from this repository.  Nothing is fetched, and nothing is executed but the
imports of the packages and the notebooks of docs/start, so the build needs no renderer, no weights
and no network.
"""

from __future__ import annotations

import hashlib
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
for folder in (ROOT, ROOT / "adapters", ROOT / "lab", ROOT / "tasks", ROOT / "docs" / "extensions"):
    sys.path.insert(0, str(folder))

import fide_plugins  # noqa: E402

project = "FIDE"
author = "FIDE contributors"
copyright = "FIDE contributors"
version = release = fide_plugins.__version__
root_doc = "index"
exclude_patterns = ["extensions"]

extensions = [
    "myst_nb",
    "sphinx_design",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "command_line",
    "field_lists",
    "public_names",
    "repository_links",
]

# -- Markdown --------------------------------------------------------------------------------------
myst_enable_extensions = ["colon_fence", "deflist"]
smartquotes = False  # "--resume" is no dash
myst_heading_anchors = 4  # [a section](page.md#section) resolves, or the build fails
suppress_warnings = [
    "myst.header",  # a table of measurements may have a small heading
    "ref.python",  # two classes are called Run; either is a fair goal
]

# -- notebooks: executed, and again when they, FIDE or the versions of packages have changed -------
_code = hashlib.sha256()
_sources = [path for name in ("fide_plugins", "lab") for path in (ROOT / name).rglob("*.py")]
for _file in (ROOT / "constraints.txt", *sorted(_sources)):
    _code.update(_file.read_bytes())
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "notebooks" / _code.hexdigest()[:16])
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # seconds of a cell; far more than it needs
nb_execution_in_temp = True  # what a notebook writes stays out of this folder
nb_merge_streams = True
nb_code_prompt_show = "Show the code"
nb_code_prompt_hide = "Hide the code"
os.environ.pop("MPLBACKEND", None)  # that of notebooks, which puts figures into the page

# -- the API ---------------------------------------------------------------------------------------
default_role = "py:obj"  # `fit` in a docstring is a link if the reference has it, else plain code
autosummary_generate = False  # tables only: what they list is written on the same page
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
add_module_names = False
maximum_signature_line_length = 88
python_use_unqualified_type_names = True
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # types of other libraries: the build has no network

# -- pages -----------------------------------------------------------------------------------------
html_theme = "furo"
html_title = "FIDE"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b6e99", "color-brand-content": "#0b6e99"},
    "dark_css_variables": {"color-brand-primary": "#6cc7ee", "color-brand-content": "#6cc7ee"},
}
pygments_style = "friendly"
pygments_dark_style = "monokai"
