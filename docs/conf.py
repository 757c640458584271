"""Configure the Sphinx site: ``sphinx-build -W --keep-going docs OUT`` (extra ``docs``)."""

from numpydoc.xref import DEFAULT_LINKS

import unprocess_gen

RECORDS = ("core.types.Counts", "core.types.Physics", "pipeline.generate.Summary", "pipeline.replay.ReplayResult")
RECORDS += ("pipeline.verify.Damage",)
"""Types that public functions return, and that are documented where they are defined."""

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
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
# numpydoc links str, ndarray and others to the inventories of Python and NumPy, which a build without network lacks
numpydoc_xref_aliases = {name: name for name in DEFAULT_LINKS}
numpydoc_xref_aliases |= {name: f"unprocess_gen.{name}" for name in unprocess_gen.__all__}
numpydoc_xref_aliases |= {record.rpartition(".")[2]: f"unprocess_gen.{record}" for record in RECORDS}
numpydoc_class_members_toctree = False
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_sidebars = {"*": []}  # only pages in folders have neighbours to list
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
