"""Which modules may import a library, and that no kernel is compiled with fast-math."""

from __future__ import annotations

import ast
import functools
from pathlib import Path

import pytest
from helpers.everywhere import KERNELS
from helpers.modules import MODULES, PACKAGE, tree

ONLY_IN = {
    "hydra": {
        *("config.composition", "config.composition_errors"),
    },
    "omegaconf": {
        *(
            "config.composition",
            "config.composition_errors",
            "config.serialization",
        ),
    },
    "joblib": {"pipeline.executors.local"},
    "llvmlite": {"simulation.kernels.simd"},
    "numba": {"simulation.kernels.jit", "simulation.kernels.simd"},
    "cv2": {
        *("sources.image.decode", "simulation.reference.isp", "pipeline.worker"),
        *("reports.explorer.views", "reports.panels", "camera_noise"),
    },
    "PIL": {"reports.pictures", "sources.image.decode", "sources.image.headers"},
    "tarfile": {"dataset.shards"},
    "tifffile": {"dataset.dng", "sources.raw.decode"},
    "rawpy": {"sources.raw.decode"},
    "scipy": {"calibration.calibrate", "calibration.frame_sums", "calibration.shape"},
    "torch": {"torch"},
    "dask": {"pipeline.executors.dask"},
    "distributed": {"pipeline.executors.dask"},
}
"""The modules that may import a library."""


@functools.cache
def imported(path: Path) -> set[str]:
    """Return the top-level names that a module imports, inside functions too."""
    names: set[str] = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            names.add((node.module or "").split(".")[0])
    return names


@pytest.mark.parametrize("library", ONLY_IN)
def test_libraries_are_imported_in_listed_modules_only(library: str) -> None:
    found = {".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in MODULES if library in imported(path)}

    assert found == ONLY_IN[library]


def test_no_kernel_is_compiled_with_fast_math() -> None:
    assert len(KERNELS) >= 20
    assert not any(kernel.targetoptions.get("fastmath") for kernel in KERNELS.values())
