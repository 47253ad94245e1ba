"""Sphinx's settings: ``make docs`` builds these pages into ``out/docs``, and a warning is an
error. The pages of ``reference/`` are made from the docstrings of the public names.
"""

from polysft_mi import set_variant

set_variant()  # without one, what renders cannot be imported

project = "PolySfT on Mitsuba 3"
author = "the authors of PolySfT on Mitsuba 3"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
source_suffix = {".md": "markdown"}
myst_heading_anchors = 4  # links to headings, as Git hosts make them
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say types, shapes and units
html_theme = "furo"
html_title = project
html_copy_source = html_show_sphinx = False
