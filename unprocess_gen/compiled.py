"""How loops become machine code. The only room that names Numba.

No fastmath: nothing is reordered and no multiply-add is fused, so every processor rounds alike.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import njit, types, version_info
from numba.extending import intrinsic, overload
from numpy.typing import NDArray


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel, and keep the machine code between processes where there is a place for it.

    Numba keeps it beside the kernel's file or below the user's cache folder; where neither can be written, every worker
    compiles for itself (10 to 40 seconds).
    """
    return _compiled(function)


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel that only kernels call: without a way in from Python, which takes a third of the time."""
    return _compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether a kernel's machine code lies ready; True where that cannot be told."""
    try:
        return bool(cast(Any, function)._cache._cache_file._load_index())
    except (AttributeError, OSError):
        return True


def _compiled(function: Callable[..., Any], **more: bool) -> Callable[..., Any]:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False, **more}
    try:
        compiled = njit(cache=True, **options)(function)
    except RuntimeError:
        return cast(Callable[..., Any], njit(**options)(function))
    if version_info.short <= LOADED_ALONE:
        _load_alone(cast(Any, compiled))
    return cast(Callable[..., Any], compiled)


LOADED_ALONE = (0, 68)
"""The last Numba whose kernels were tried to run without its registries; tested with the one that is installed."""


def _load_alone(compiled: Any) -> None:
    """Have kept machine code loaded without Numba's registries: what only a compiler needs takes 0.4 s and 25 MB.

    Numba imports them (SciPy among them, where it is installed) before it looks for kept code, whose only symbols are
    those of the context and of the runtime. Where none lies ready, or Numba is another inside than it was, its own way
    is gone.
    """
    try:
        cache, its_own_way = compiled._cache, compiled._cache.load_overload
    except AttributeError:
        return

    def load(signature: Any, target: Any) -> Any:
        try:
            from numba.core.runtime.nrt import rtsys

            rtsys.initialize(target)
            found = cache._load_overload(signature, target)
        except Exception:
            found = None
        return its_own_way(signature, target) if found is None else found

    cache.load_overload = load


def eight_bytes(array: NDArray[Any], at: int) -> np.uint64:
    """Return bytes ``at`` to ``at + 7`` of an array's memory as one number, the first in its lowest bits.

    Compiled it is one instruction that checks nothing: the array must lie in one piece, and the bytes be its own.
    """
    return np.uint64(int.from_bytes(array.tobytes()[at : at + 8], "little"))


@overload(eight_bytes, inline="always")
def _compiled_eight_bytes(array: Any, at: Any) -> Callable[..., Any]:
    def load(array: Any, at: Any) -> Any:
        return _load_eight_bytes(array, at)

    return load


def _typed_load(typing: Any, array: Any, at: Any) -> Any:
    def load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        place = builder.gep(builder.bitcast(data, ir.IntType(8).as_pointer()), [arguments[1]])
        number = builder.load(builder.bitcast(place, ir.IntType(64).as_pointer()))
        number.align = 1
        return builder.bswap(number) if sys.byteorder == "big" else number

    return types.uint64(array, at), load


_load_eight_bytes: Callable[..., Any] = intrinsic(_typed_load)
