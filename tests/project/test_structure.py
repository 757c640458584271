"""Limits of size, circles of imports, which modules may import a library, and kernels without fast-math."""

from __future__ import annotations

import ast
import io
import tokenize
from pathlib import Path

import pytest
from helpers.everywhere import KERNELS
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


MODULE_OF = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in MODULES}
NAMES = {name.removesuffix(".__init__") for name in MODULE_OF}


def imports(path: Path) -> set[str]:
    """Return the modules that a module imports, for type checking and inside functions too."""
    found: set[str] = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in NAMES else node.module or "" for name in names}
    return found


IMPORTS = {name.removesuffix(".__init__"): imports(path) for name, path in MODULE_OF.items()}
GRAPH = {name: modules & NAMES for name, modules in IMPORTS.items()}

ONLY_IN = {
    "hydra": {"config.composition", "config.composition_errors"},
    "omegaconf": {"config.composition", "config.composition_errors", "config.overrides", "config.serialization"},
    "joblib": {"pipeline.executors.local"},
    "llvmlite": {"simulation.kernels.simd"},
    "numba": {"simulation.kernels.jit", "simulation.kernels.simd"},
    "cv2": {
        *("sources.image.decode", "simulation.reference.isp", "pipeline.worker"),
        *("reports.explorer.views", "reports.panels", "reports.scoring.metrics", "picture_isp", "picture_mean"),
    },
    "PIL": {"dataset.notebook", "reports.pictures", "sources.image.headers", "sources.image.heif"},
    "pillow_heif": {"sources.image.heif"},
    "tarfile": {"dataset.shards"},
    "OpenEXR": {"sources.linear.exr"},
    "tifffile": {"dataset.dng", "sources.linear.files", "sources.raw.tags"},
    "rawpy": {"sources.raw.decode"},
    "scipy": {"calibration.calibrate", "calibration.frame_sums", "calibration.shape", "camera_fit"},
    "torch": {"torch"},
    "dask": {"pipeline.executors.dask"},
    "distributed": {"pipeline.executors.dask"},
}
"""The modules that may import a library."""


@pytest.mark.parametrize("library", ONLY_IN)
def test_libraries_are_imported_in_listed_modules_only(library: str) -> None:
    users = {name for name, modules in IMPORTS.items() if library in {module.split(".")[0] for module in modules}}
    assert {name.partition(".")[2] for name in users} == ONLY_IN[library]


def test_no_kernel_is_compiled_with_fast_math() -> None:
    assert len(KERNELS) >= 20
    assert not any(kernel.targetoptions.get("fastmath") for kernel in KERNELS.values())


def test_no_import_closes_a_circle() -> None:
    """Modules that import none that is left, or that none imports, are removed until only circles are left."""
    left = {name: modules - {name} for name, modules in GRAPH.items()}
    while True:
        imported = set[str]().union(*left.values())
        kept = {name: modules & left.keys() for name, modules in left.items() if modules & left.keys()}
        kept = {name: modules for name, modules in kept.items() if name in imported}
        if kept == left:
            break
        left = kept
    assert sorted(left) == []


def test_core_contains_what_several_packages_use() -> None:
    users: dict[str, set[str]] = {name: set() for name in GRAPH if name.startswith("unprocess_gen.core.")}
    for name, modules in GRAPH.items():
        for module in modules & users.keys():
            users[module].add(".".join(name.split(".")[:2]))
    assert {name: found for name, found in users.items() if len(found - {"unprocess_gen.core"}) < 2} == {}


def test_no_module_and_no_function_is_too_long() -> None:
    assert [name for path in MODULES for name in too_long(path)] == []
