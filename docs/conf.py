"""How the site is built: `make docs`, or `sphinx-build -W -c docs . out/site` in the checkout.

The source folder is the checkout itself, so that links from page to page, to notebooks and to files
are the same on the site as in the repository.
"""

import sys
from pathlib import Path

from vkc_pin import __version__

sys.path.insert(0, str(Path(__file__).parent / "_ext"))
sys.path.insert(0, str(Path(__file__).parents[1]))  # for `docs.pictures`

project = "vkc_pin"
author = "the authors of vkc_pin"
copyright = "2026, the authors of vkc_pin"
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "svg_math",
    "vkc_site",
]
root_doc = "docs/index"
include_patterns = [
    "docs/**",
    "notebooks/*.ipynb",
    "CHANGELOG.md",
    "robots/husky_ur5e/README.md",
    "tools/README.md",
]
exclude_patterns = [
    "docs/_*",
    "**/.ipynb_checkpoints",
    ".*",
    "out",
    "build",
    "dist",
    "tests",
    "vkc_pin",
    "scenes",
]
nitpicky = True
# Names of other packages and of modules have no pages here; single backticks in docstrings are code
# first, and links where they happen to lead.
nitpick_ignore_regex = [("py:.*", r"(?!vkc_pin\.).*|vkc_pin\.\w+\..*")]
suppress_warnings = ["ref.python"]  # attributes of the same name in several classes

# Markdown as GitHub reads it.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4
myst_dmath_double_inline = False
nb_execution_mode = "off"  # the tests run the notebooks
nb_merge_streams = True

# Docstrings.
default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 100
python_use_unqualified_type_names = True
add_module_names = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
toc_object_entries_show_parents = "hide"

# Pages. Nothing is loaded from elsewhere.
html_theme = "furo"
html_title = f"vkc_pin {version}"
html_math_renderer = "svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
copybutton_exclude = ".linenos, .gp, .go"
