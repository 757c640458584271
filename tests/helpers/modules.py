"""The modules of the package, each parsed once for all tests of a process."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "unprocess_gen"
MODULES = tuple(sorted(PACKAGE.rglob("*.py")))


@cache
def tree(path: Path) -> ast.Module:
    """Return the syntax tree of a module, which takes 4 ms to parse and is not to be changed."""
    return ast.parse(path.read_text(encoding="utf-8"))
