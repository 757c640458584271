"""Configure the Sphinx site: ``sphinx-build -W --keep-going docs OUT`` (extra ``docs``)."""

from collections.abc import Iterator
from pathlib import Path

from docutils import nodes
from numpydoc.xref import DEFAULT_LINKS
from sphinx import addnodes
from sphinx.application import Sphinx

import unprocess_gen
from unprocess_gen.core.fields import Field
from unprocess_gen.simulation.plan import PlanRecord, fields_of

RECORDS = (
    "simulation.frames.Counts",
    "simulation.plan.Physics",
    "pipeline.generate.Summary",
    "pipeline.replay.ReplayResult",
)
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
autodoc_mock_imports = ["torch"]  # no dependency; only unprocess_gen.torch imports it
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
html_search_scorer = str(Path(__file__).with_name("scorer.js"))


def index_keys(app: Sphinx, doctree: nodes.document) -> None:
    """Give each key and column of the reference an anchor and an index entry, which the search finds first."""
    if app.env.docname not in ("reference/settings", "reference/columns"):
        return
    for row in list(doctree.findall(nodes.row)):
        literal = row.children[0].next_node(nodes.literal)
        if literal is None:
            continue
        sections = [node for node in _ancestors(row) if isinstance(node, nodes.section)]
        group = sections[-2].next_node(nodes.title).next_node(nodes.literal) if len(sections) > 1 else None
        name = f"{group.astext()}.{literal.astext()}" if group is not None else literal.astext()
        target = nodes.target("", "", ids=[nodes.make_id(f"key-{name}")])
        literal.parent.insert(0, [addnodes.index(entries=[("single", name, target["ids"][0], "", None)]), target])


def _ancestors(node: nodes.Node) -> Iterator[nodes.Element]:
    while node.parent is not None:
        node = node.parent
        yield node


def list_fields(app: Sphinx, what: str, name: str, record: object, options: object, lines: list[str]) -> None:
    """List the fields of a record, whose meanings stand in their annotations, as the section Attributes."""
    if what != "class" or not issubclass(record, PlanRecord):
        return
    lines += ["", "Attributes", "----------"]
    for field, (kind, declared) in fields_of(record).items():
        text = ", ".join(filter(None, (declared.meaning, declared.unit))) if isinstance(declared, Field) else "record"
        lines += [f"{field} : {getattr(kind, '__name__', kind)}", f"    {text}"]


def setup(app: Sphinx) -> None:
    """Connect the index of keys, and the fields of records before numpydoc reads docstrings."""
    app.connect("doctree-read", index_keys)
    app.connect("autodoc-process-docstring", list_fields, priority=100)
