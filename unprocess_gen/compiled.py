"""How loops become machine code. The only room that names Numba.

No fastmath: nothing is reordered and no multiply-add is fused, so every processor rounds alike.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from llvmlite.binding import parse_assembly
from numba import njit, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.typed_passes import NopythonTypeInference
from numba.extending import intrinsic, overload
from numpy.typing import NDArray


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel, and keep the machine code between processes where there is a place for it.

    Numba keeps it beside the kernel's file or below the user's cache folder; where neither can be written, every worker
    compiles for itself (5 to 20 seconds).
    """
    return _compiled(function, no_cfunc_wrapper=True)


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel that only kernels call: without a way in from Python, and no farther than they need it.

    Half the time is spared, a sixth of a run's by what `_InnerLibrary` leaves out.
    """
    return _compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True, pipeline_class=_InnerCompiler)


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether a kernel's machine code lies ready, here or from another process; True where that cannot be told."""
    try:
        return bool(cast(Any, function).signatures or cast(Any, function)._cache._cache_file._load_index())
    except (AttributeError, OSError):
        return True


class _InnerLibrary(JITCodeLibrary):
    """The code of a kernel as the kernels that call it want it: neither optimised nor made machine code.

    Each of those takes the code in and does both with all that it is made of, so that a kernel five calls deep would
    have been through it six times. The machine code is that of nothing but the variable that Numba looks for, the
    environment. Where another Numba names these steps otherwise, it does them as ever.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        cast(Any, self)._finalize_dynamic_globals()
        whole = self._final_module
        for function in whole.functions:
            if not function.is_declaration and function.linkage.name == "external":
                function.linkage = "linkonce_odr"
        environments = [one.name for one in whole.global_variables if one.name.startswith("_ZN08NumbaEnv")]
        stub = "\n".join(f'@"{name}" = common global i64 0' for name in environments)
        self._shared_module = whole
        self._final_module = cast(Any, parse_assembly)(stub)
        self._final_module.name = whole.name
        cast(Any, super())._finalize_final_module()


class _IntoInnerLibrary(FunctionPass):
    _name = "into_inner_library"

    def __init__(self) -> None:
        cast(Any, FunctionPass).__init__(self)

    def run_pass(self, state: Any) -> bool:
        state.library = cast(Any, _InnerLibrary)(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return True


cast(Any, register_pass)(mutates_CFG=False, analysis_only=False)(_IntoInnerLibrary)


class _InnerCompiler(CompilerBase):
    def define_pipelines(self) -> list[Any]:
        passes = cast(Any, DefaultPassBuilder).define_nopython_pipeline(self.state)
        passes.add_pass_after(_IntoInnerLibrary, NopythonTypeInference)
        passes.finalize()
        return [passes]


def _compiled(function: Callable[..., Any], **more: Any) -> Callable[..., Any]:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False, **more}
    try:
        return cast(Callable[..., Any], njit(cache=True, **options)(function))
    except RuntimeError:
        return cast(Callable[..., Any], njit(**options)(function))


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
