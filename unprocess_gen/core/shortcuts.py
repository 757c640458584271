"""Two things that Numba does at every start or compilation and that these kernels do not need, left out; one it lacks.

They reach inside Numba, so they are asked for with versions alone that they were tried with: up to `compiled.TRIED`,
the oldest and the newest of those by `tests/test_everywhere.py`.

Measured: the registries take 0.4 s of every start and 25 MB; machine code of inner kernels a sixth of the time of a
first run.
"""

from __future__ import annotations

from typing import Any, cast

from llvmlite.binding import parse_assembly
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.typed_passes import NopythonTypeInference


def keep_for(compiled: Any, sources: str) -> None:
    """Have machine code kept for these sources alone, not for any that leave the kernel's own file as it was.

    They go where Numba compares its version, before it reads anything else: what was kept of other sources may hold
    types that are gone. Where Numba is another inside than it was, it minds the kernel's own file.
    """
    try:
        file = compiled._cache._cache_file
        file._version = f"{file._version} of {sources}"
    except AttributeError:
        return


def load_alone(compiled: Any) -> None:
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


class InnerCompiler(CompilerBase):
    """Numba's own steps, but for the library."""

    def define_pipelines(self) -> list[Any]:
        """Return them."""
        passes = cast(Any, DefaultPassBuilder).define_nopython_pipeline(self.state)
        passes.add_pass_after(_IntoInnerLibrary, NopythonTypeInference)
        passes.finalize()
        return [passes]
