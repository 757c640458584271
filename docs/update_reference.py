"""Write the parts of the documentation that follow from the code: manifest columns, drawing of the packages.

``python docs/update_reference.py`` rewrites the text between the markers ``<!-- NAME: from the code -->`` and
``<!-- end of NAME -->`` of each page; a test compares the pages with the code.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import grimp

from unprocess_gen.dataset.columns import COLUMNS

ROOT = Path(__file__).parents[1]
PACKAGE = "unprocess_gen"
LAYERS = (
    ("cli",),
    ("reports",),
    ("pipeline",),
    ("planning", "sources", "dataset"),
    ("config",),
    ("simulation",),
    ("core",),
)
"""Packages from the command line down to core; the order that import-linter holds."""


def columns() -> str:
    """Return the table of manifest columns; the nine matrix elements share a row."""
    rows = ["| column | meaning |", "|---|---|"]
    for column in COLUMNS:
        if column.name == "rgb2cam_00":
            rows.append(f"| `rgb2cam_00` … `rgb2cam_22` | {column.meaning} |")
        elif not column.name.startswith("rgb2cam_"):
            rows.append(f"| `{column.name}` | {column.meaning} |")
    return "\n".join(rows)


def drawing() -> str:
    """Return a Mermaid graph of the packages, an arrow for every import, and the modules of each package."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    modules = [module for module in sorted(graph.modules) if module.count(".") >= 2 and not graph.find_children(module)]
    lines = ["```mermaid", "flowchart TD"]
    for layer in LAYERS:
        lines.append(f"    subgraph {'_'.join(layer)}_layer[ ]\n        " + "\n        ".join(layer) + "\n    end")
    for importer in (package for layer in LAYERS for package in layer):
        for imported in (package for layer in LAYERS for package in layer):
            if importer != imported and graph.direct_import_exists(
                importer=f"{PACKAGE}.{importer}", imported=f"{PACKAGE}.{imported}", as_packages=True
            ):
                lines.append(f"    {importer} --> {imported}")
    lines += ["```", "", "| package | purpose | modules |", "|---|---|---|"]
    for package in (package for layer in LAYERS for package in layer):
        names = [module.removeprefix(f"{PACKAGE}.{package}.") for module in modules if module.split(".")[1] == package]
        lines.append(f"| `{package}` | {purpose(package)} | {', '.join(f'`{name}`' for name in names)} |")
    return "\n".join(lines)


def purpose(package: str) -> str:
    """Return the docstring of a package in one line."""
    text = (ROOT / PACKAGE / package / "__init__.py").read_text(encoding="utf-8")
    return text.split('"""')[1].split("\n\n")[0].replace("\n", " ").replace("``", "`").strip()


GENERATED: dict[str, tuple[str, Callable[[], str]]] = {
    "columns": ("docs/dataset.md", columns),
    "packages": ("docs/design/architecture.md", drawing),
}
"""Generated parts: name of the markers, page, function that returns the text."""


def updated(name: str) -> tuple[Path, str, str]:
    """Return a page, its present text and its text with one part generated from the code."""
    page, generate = GENERATED[name]
    path = ROOT / page
    text = path.read_text(encoding="utf-8")
    begin, end = f"<!-- {name}: from the code -->", f"<!-- end of {name} -->"
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    assert pattern.search(text), f"{page} has no markers of {name}"
    return path, text, pattern.sub(lambda _: f"{begin}\n{generate()}\n{end}", text)


if __name__ == "__main__":
    for part in GENERATED:
        page, before, after = updated(part)
        page.write_text(after, encoding="utf-8")
        print(f"{page.relative_to(ROOT)}: {part} {'unchanged' if before == after else 'updated'}")
