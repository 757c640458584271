"""How loops become machine code. Numba is named here, in `lanes` and in `shortcuts`, nowhere else.

No fastmath: nothing is reordered and no multiply-add is fused, so every processor rounds alike.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from numba import njit, version_info

TRIED = (0, 68)
"""The last Numba that `shortcuts` was tried with, from the oldest allowed on; a newer one goes its own way."""


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel, and keep the machine code between processes where there is a place for it.

    Numba keeps it beside the kernel's file or below the user's cache folder; where neither can be written, every worker
    compiles for itself (5 to 20 seconds).
    """
    return _compiled(function, no_cfunc_wrapper=True)


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel that only kernels call: without a way in from Python, and no farther than they need it.

    A third of the time is spared, and half of it with `shortcuts.InnerCompiler`.
    """
    more: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    if version_info.short <= TRIED:
        from unprocess_gen.core.shortcuts import InnerCompiler

        more["pipeline_class"] = InnerCompiler
    return _compiled(function, **more)


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether a kernel's machine code lies ready, here or from another process; True where that cannot be told."""
    try:
        return bool(cast(Any, function).signatures or cast(Any, function)._cache._cache_file._load_index())
    except (AttributeError, OSError):
        return True


@functools.cache
def _sources() -> str:
    """Return what tells the package's files from what they were: a kernel is made of those that it calls, too."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    stamps = [(file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in files]
    return hashlib.sha256(repr(stamps).encode()).hexdigest()


def _compiled(function: Callable[..., Any], **more: Any) -> Callable[..., Any]:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False, **more}
    try:
        compiled = njit(cache=True, **options)(function)
    except RuntimeError:
        return cast(Callable[..., Any], njit(**options)(function))
    if version_info.short <= TRIED:
        from unprocess_gen.core.shortcuts import keep_for, load_alone

        keep_for(cast(Any, compiled), _sources())
        load_alone(cast(Any, compiled))
    return cast(Callable[..., Any], compiled)
