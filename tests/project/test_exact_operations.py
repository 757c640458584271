"""Modules that decide bytes of a dataset call only operations that every machine rounds alike."""

from __future__ import annotations

import ast
import math

import numpy as np
import pytest
from helpers.modules import MODULES, PACKAGE, tree

EXACT_FUNCTIONS = {
    *("abs", "add", "subtract", "multiply", "divide", "sqrt", "square", "rint", "floor", "ceil", "trunc", "minimum"),
    *("maximum", "copysign", "isfinite", "isnan", "fabs", "frexp", "ldexp", "gcd", "lcm", "nextafter", "prod"),
}
"""Functions of NumPy and `math` whose results IEEE 754 or integer arithmetic determines."""

UNORDERED_SUMS = {
    *("dot", "vdot", "inner", "matmul", "tensordot", "einsum", "linalg", "fft", "convolve", "correlate", "interp"),
    *("sum", "mean", "average", "var", "std", "polyval", "polyfit"),
}
ALLOWED_IN_OPENCV = {"imdecode", "error", "getNumThreads", "setNumThreads", "utils"}

OUTSIDE_OUTPUT = {
    *("core/exact_distributions.py", "simulation/lookup_tables.py", "simulation/tone_curves.py"),
    *("simulation/reference/isp.py", "simulation/reference/unprocess.py"),
    "config/iso_forms.py",  # a logarithm decides only whether a config is refused
    *(
        "dataset/dng.py",
        "reports",
        "calibration",
        "statistics",
        "torch.py",
        "camera_noise.py",
        "camera_fit.py",
        "picture_isp.py",
        "picture_mean.py",
    ),
}
"""Paths below the package of modules that no byte of a dataset depends on, or that cannot differ: `decimal`, tables
with a checked SHA-256, the formulas of the reference, its inverse, measurements, drawings and exports."""


def inexact_operations(module: ast.Module) -> list[str]:
    """Return the expressions of a module that machines may round differently."""
    found: list[ast.AST] = []
    for node in ast.walk(module):
        match node:
            case ast.BinOp(op=ast.MatMult()) | ast.Call(func=ast.Name(id="pow")):
                found.append(node)
            case ast.BinOp(op=ast.Pow(), left=ast.Constant()) | ast.BinOp(op=ast.Pow(), right=ast.Constant(value=2)):
                pass
            case ast.BinOp(op=ast.Pow()):
                found.append(node)
            case ast.Attribute(value=ast.Name(id="np"), attr=name) if name not in EXACT_FUNCTIONS:
                found += [node] * (isinstance(getattr(np, name, None), np.ufunc) or name in UNORDERED_SUMS)
            case ast.Attribute(value=ast.Name(id="math"), attr=name) if name not in EXACT_FUNCTIONS:
                found += [node] * callable(getattr(math, name))
            case ast.Attribute(value=ast.Name(id="cv2"), attr=name) if not name.startswith("IMREAD_"):
                found += [node] * (name not in ALLOWED_IN_OPENCV)
    return [ast.unparse(node) for node in found]


def test_modules_call_no_function_that_machines_round_differently() -> None:
    found = {
        str(path.relative_to(PACKAGE)): inexact_operations(tree(path))
        for path in MODULES
        if not any(path.is_relative_to(PACKAGE / outside) for outside in OUTSIDE_OUTPUT)
    }
    assert len(found) > 50
    assert {name: operations for name, operations in found.items() if operations} == {}


INEXACT = ("a @ b", "np.exp(a)", "np.einsum('ij,j', a, b)", "math.log(2)", "a ** 2.2", "a ** b", "pow(a, b)")


@pytest.mark.parametrize("line", [*INEXACT, "cv2.resize(a)"])
def test_functions_that_round_differently_are_found(line: str) -> None:
    assert inexact_operations(ast.parse(line))
