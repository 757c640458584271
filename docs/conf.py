"""Configure the Sphinx site: ``sphinx-build -W --keep-going docs OUT`` (extra ``docs``)."""

import unprocess_gen

project = "unprocess_gen"
author = "the unprocess_gen authors"
version = release = unprocess_gen.__version__

extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.autosummary"]
nitpicky = True
highlight_language = "none"

myst_heading_anchors = 4

autodoc_typehints = "none"
autosummary_generate = False
default_role = "autolink"
numpydoc_class_members_toctree = False
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = project
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "header_links_before_dropdown": 6,
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "show_toc_level": 2,
}
