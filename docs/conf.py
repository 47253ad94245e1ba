"""Sphinx's settings: ``make docs`` builds these pages into ``out/docs``, and a warning is an
error.
"""

project = "PolySfT on Mitsuba 3"
author = "the authors of PolySfT on Mitsuba 3"
extensions = ["myst_parser"]
source_suffix = {".md": "markdown"}
myst_heading_anchors = 4  # links to headings, as Git hosts make them
html_theme = "furo"
html_title = project
html_copy_source = html_show_sphinx = False
