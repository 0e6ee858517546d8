"""How Sphinx builds the site: pages in Markdown, the reference from docstrings, nothing fetched when it is read."""

import sys
from pathlib import Path

import numpy.typing

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]
numpy.typing.ArrayLike = type("ArrayLike", (), {"__module__": "numpy.typing"})  # shown by its name, not as its union

project = "modal-workbench"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "public_names", "command_options"]

html_theme = "furo"
html_title = "modal-workbench"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
smartquotes_action = "D"  # dashes only: q' is a rate, not a quotation

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_use_rtype = False
default_role = "py:obj"  # `Modes` in a docstring links to Modes where that is documented
python_use_unqualified_type_names = True
