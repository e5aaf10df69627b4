"""Sphinx settings. The sources are the Markdown pages of the whole repository: links work on a code host as well."""

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs/_ext")]
os.environ["PYTHONPATH"] = str(ROOT)

import fgtrack  # noqa: E402

suppress_warnings = ["ref.python"]  # annotations with Discriminator("kind") name the field of several classes
project = "fgtrack"
author = "fgtrack contributors"
release = fgtrack.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
    "reference",
]
root_doc = "docs/index"
html_extra_path = ["_ext/index.html"]  # leads from out/docs/index.html to the root page
include_patterns = ["CHANGELOG.md", "CONTRIBUTING.md", "docs/**.md", "docs/generated/**.rst", "experiments/**.md"]
exclude_patterns = [".venv", ".git", "out", "build", "tests", "fgtrack", "docs/tutorials"]
html_theme = "furo"
html_title = "fgtrack"
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
default_role = "literal"

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

napoleon_google_docstring = False
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"

sphinx_gallery_conf = {
    "examples_dirs": "docs/tutorials",
    "gallery_dirs": "docs/generated/tutorials",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "capture_repr": ("_repr_html_",),
    "download_all_examples": False,
    "show_memory": False,
    "write_computation_times": False,
}
