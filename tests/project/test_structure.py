"""Limits of size: no module above 500 lines of code, no function above 45."""

from __future__ import annotations

import ast
import io
import tokenize
from pathlib import Path

import pytest
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


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_no_module_and_no_function_is_too_long(path: Path) -> None:
    module = tree(path)
    lines = code_lines(path.read_text(encoding="utf-8"), module)
    assert len(lines) <= MODULE
    functions = [node for node in ast.walk(module) if isinstance(node, ast.FunctionDef)]
    long = {node.name for node in functions if len(lines & set(range(node.lineno, node.end_lineno + 1))) > FUNCTION}
    assert not long
