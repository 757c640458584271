"""Limits of size: no module above 500 lines of code, no function above 45."""

from __future__ import annotations

import ast
import io
import tokenize
from pathlib import Path

from helpers.modules import MODULES, PACKAGE, tree

MODULE, FUNCTION = 500, 45

NO_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENCODING, tokenize.ENDMARKER),
}


def code_lines(text: str, module: ast.Module) -> set[int]:
    """Return the numbers of the lines that contain code; docstrings, comments and blank lines contain none."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = {line for token in tokens if token.type not in NO_CODE for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(module):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def too_long(path: Path) -> list[str]:
    """Return the name of a module that is too long, and of its functions that are."""
    module = tree(path)
    lines = code_lines(path.read_text(encoding="utf-8"), module)
    functions = [node for node in ast.walk(module) if isinstance(node, ast.FunctionDef)]
    long = [node.name for node in functions if len(lines & set(range(node.lineno, node.end_lineno + 1))) > FUNCTION]
    return [f"{path.relative_to(PACKAGE)}: {name}" for name in [*long, *["module"] * (len(lines) > MODULE)]]


def test_no_module_and_no_function_is_too_long() -> None:
    assert [name for path in MODULES for name in too_long(path)] == []
