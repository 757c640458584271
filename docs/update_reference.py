"""Write the parts of documentation that follow from the code: reference and packages.

``python docs/update_reference.py`` rewrites the text between the markers ``<!-- NAME: from the code -->`` and
``<!-- end of NAME -->`` of each page, and the files of `GENERATED_FILES`; a test compares them with the code.
"""

from __future__ import annotations

import importlib.util
import inspect
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from unittest.mock import MagicMock

import grimp

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))
from light_page import light_tables  # noqa: E402
from reference_pages import PAGES  # noqa: E402

PACKAGE = "unprocess_gen"
LAYERS = (
    ("cli",),
    ("reports",),
    ("pipeline", "calibration"),
    ("planning", "sources", "dataset"),
    ("config",),
    ("simulation",),
    ("core",),
)
"""Packages from the command line down to core; the order that import-linter holds."""


PACKAGES = tuple(package for layer in LAYERS for package in layer)


@cache
def package_imports() -> dict[str, list[str]]:
    """Return the packages that each package imports, in the order of `LAYERS`."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None, exclude_type_checking_imports=True)
    return {
        importer: [
            imported
            for imported in PACKAGES
            if importer != imported
            and graph.direct_import_exists(
                importer=f"{PACKAGE}.{importer}", imported=f"{PACKAGE}.{imported}", as_packages=True
            )
        ]
        for importer in PACKAGES
    }


def package_table() -> str:
    """Return the table of the packages and their purposes; the drawing shows what they import."""
    return "\n".join(["| package | purpose |", "|---|---|", *(f"| `{name}` | {purpose(name)} |" for name in PACKAGES)])


def package_drawing() -> str:
    """Return an SVG of the packages by layer, without the arrows that follow from other arrows.

    Code hosts and Sphinx show an SVG without a script; a Mermaid graph needs one, which is loaded from a server.
    """
    width, row, box_width, box_height = 520, 72, 104, 36
    centre = {
        package: (width * (2 * place + 1) // (2 * len(layer)), row * number + 32)
        for number, layer in enumerate(LAYERS)
        for place, package in enumerate(layer)
    }
    imports = package_imports()
    height = row * (len(LAYERS) - 1) + 64
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
        ' font-family="sans-serif" font-size="15" text-anchor="middle">',
        "<title>Packages and their imports</title>",
        '<marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#555"/></marker>',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for importer, imported in imports.items():
        implied = {further for package in imported for further in _reachable(package)}
        for package in imported:
            if package not in implied:
                (x1, y1), (x2, y2) = centre[importer], centre[package]
                ends = f'x1="{x1}" y1="{y1 + box_height // 2}" x2="{x2}" y2="{y2 - box_height // 2}"'
                lines.append(f'<line {ends} stroke="#555" marker-end="url(#tip)"/>')
    for package, (x, y) in centre.items():
        corner = f'x="{x - box_width // 2}" y="{y - box_height // 2}" width="{box_width}" height="{box_height}"'
        lines.append(f'<rect {corner} rx="5" fill="#eef3f8" stroke="#345"/>')
        lines.append(f'<text x="{x}" y="{y + 5}" fill="#123">{package}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _reachable(package: str) -> set[str]:
    """Return all packages that a package imports, directly or through others."""
    imported = package_imports()[package]
    return {*imported, *(further for one in imported for further in _reachable(one))}


def purpose(package: str) -> str:
    """Return the docstring of a package in one line."""
    text = (ROOT / PACKAGE / package / "__init__.py").read_text(encoding="utf-8")
    return text.split('"""')[1].split("\n\n")[0].replace("\n", " ").replace("``", "`").strip()


def names_table() -> str:
    """Return a table of the names of the API page: arguments and first sentence, readable without Sphinx."""
    page = (ROOT / "docs/reference/api.md").read_text(encoding="utf-8")
    module, rows = PACKAGE, ["| name | purpose |", "|---|---|"]
    is_missing = importlib.util.find_spec("torch") is None
    if is_missing:
        sys.modules["torch"] = MagicMock()
    for kind, name, record in re.findall(r"^\.\. (\w+):: ([\w.]+)(\(\))?$", page, re.MULTILINE):
        if kind == "currentmodule":
            module = name
        elif kind in ("autofunction", "autoclass", "autoexception") and not name.startswith(f"{PACKAGE}.simulation"):
            place, _, last = (name if "." in name else f"{module}.{name}").rpartition(".")
            entry = getattr(importlib.import_module(place), last)
            given = "" if record or kind == "autoexception" else f"({', '.join(inspect.signature(entry).parameters)})"
            shown = f"torch.{last}" if module.endswith(".torch") else last
            first = inspect.getdoc(entry).partition("\n\n")[0].replace("\n", " ").replace("``", "`")
            rows.append(f"| `{shown}{given}` | {first.replace('|', chr(92) + '|')} |")
    if is_missing:  # no test may import a module without PyTorch
        del sys.modules["torch"], sys.modules[f"{PACKAGE}.torch"]
    return "\n".join(rows)


GENERATED: dict[str, tuple[str, Callable[[], str]]] = {
    "packages": ("docs/design/architecture.md", package_table),
    "names": ("docs/reference/api.md", names_table),
    "lights": ("docs/guides/own_camera.md", light_tables),
}
"""Generated parts: name of the markers, page, function that returns the text."""

GENERATED_FILES: dict[str, Callable[[], str]] = {
    "docs/design/packages.svg": package_drawing,
    **PAGES,
}
"""Generated files, and the functions that return their text."""


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
    for name, generate_file in GENERATED_FILES.items():
        path, text = ROOT / name, generate_file()
        unchanged = path.exists() and path.read_text(encoding="utf-8") == text
        path.write_text(text, encoding="utf-8")
        print(f"{name}: {'unchanged' if unchanged else 'updated'}")
