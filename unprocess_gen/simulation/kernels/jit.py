"""Compile kernels with Numba and cache their machine code on disk.

Numba is imported here and in `simulation.kernels.simd` only. Kernels are compiled without fastmath: the compiler
neither reorders operations nor fuses multiply-add, so all CPUs round alike.

Compiled kernels contain the machine code of the kernels that they call. Numba checks only the file of the outer kernel,
so its cache could return machine code of an older version of another file: wrong bytes. `kernel_cache_folder` prevents
this. Its name contains a digest of all files below `core` and `simulation`, the packages that kernels may depend on.
Editing any other package, or the modification time of a file, does not change it. A kernel in another package may call
only kernels of these two packages or of its own file, which Numba checks itself.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numba
from numba.extending import overload

numba_config: Any = numba.config
"""Numba's settings: public names without types, assigned when Numba is imported."""

_LOGGER = logging.getLogger(__name__)

KERNEL_PACKAGES = ("core", "simulation")
"""The packages whose files determine the machine code of kernels."""

PREFIX = "unprocess_gen-"
"""The beginning of the name of a folder of machine code; the digest of the sources follows."""


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel that Python calls, at its first call with new argument types, and cache its machine code."""
    return _compile(function, no_cfunc_wrapper=True)


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel that only other kernels call, without the entry point for Python.

    Omitting the entry point saves a third of the compilation time.
    """
    return _compile(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


_INNER_OPTIONS: Any = {"nogil": True, "error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def by_class(implementations: Mapping[type, Callable[..., Any]]) -> Callable[..., Any]:
    """Make a function for kernels that calls one of several, chosen by the class of its first argument, a named tuple.

    A class without a function of its own has that of its base. Compiled kernels contain only the chosen one, because
    Numba knows the class when it compiles them. All take the same number of arguments.
    """

    def call(first: Any, *others: Any) -> Any:
        return _implementation(implementations, type(first))(first, *others)

    def choose(first: Any, *others: Any) -> Any:
        chosen = _implementation(implementations, first.instance_class)
        return getattr(chosen, "py_func", chosen)

    overload(call, jit_options=_INNER_OPTIONS, strict=False)(choose)
    return call


def _implementation(implementations: Mapping[type, Any], kind: type) -> Any:
    base = next((base for base in kind.__mro__ if base in implementations), None)
    if base is None:
        raise TypeError(f"{kind.__name__}: no kernel takes it")
    return implementations[base]


@functools.cache
def kernel_cache_folder() -> Path | None:
    """Folder for machine code of the current sources; None if there is no place to write it.

    It is in ``NUMBA_CACHE_DIR`` if this variable is set, else in the package's ``__pycache__``, else in
    ``$XDG_CACHE_HOME/unprocess_gen`` (``~/.cache/unprocess_gen`` by default).
    """
    package = Path(__file__).parents[2]
    try:
        name = PREFIX + source_digest(package)
    except OSError:  # the sources are not readable, for example in a frozen application
        return None
    in_package = package / "__pycache__"
    in_home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "unprocess_gen"
    given = numba_config.CACHE_DIR
    for parent in [Path(given)] if given else [in_package, in_home]:
        folder = parent / name
        try:
            is_new = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            if is_new and parent == in_package:
                _remove_others(folder)
            return folder
    return None


def source_digest(package: Path) -> str:
    """Digest of the names and contents of all files below `KERNEL_PACKAGES`, 16 hex digits."""
    digest = hashlib.sha256()
    for name in KERNEL_PACKAGES:
        paths = sorted((package / name).rglob("*.py"))
        if not paths:
            raise FileNotFoundError(package / name)
        for path in paths:
            content = path.read_bytes()
            digest.update(f"{path.relative_to(package).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:16]


def _remove_others(folder: Path) -> None:
    """Remove machine code of earlier versions of the sources; each version takes up to 20 MB."""
    for other in folder.parent.glob(f"{PREFIX}*"):
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)


def _compile(function: Callable[..., Any], **options: bool) -> Callable[..., Any]:
    """Dispatcher of Numba, with a cache only if it is in `kernel_cache_folder`."""
    compiler = functools.partial(numba.njit, nogil=True, error_model="numpy", fastmath=False, **options)
    folder = kernel_cache_folder()
    if folder is None:
        return cast(Callable[..., Any], compiler()(function))
    given, numba_config.CACHE_DIR = numba_config.CACHE_DIR, str(folder)
    try:
        dispatcher: Any = compiler(cache=True)(function)
    except RuntimeError:  # Numba caches no function that has no file
        return cast(Callable[..., Any], compiler()(function))
    finally:
        numba_config.CACHE_DIR = given
    if hasattr(dispatcher, "stats") and not Path(dispatcher.stats.cache_path).is_relative_to(folder):
        # a Numba that ignores CACHE_DIR could return machine code of other sources
        return cast(Callable[..., Any], compiler()(function))
    if hasattr(dispatcher, "_cache"):
        _survive_damage(dispatcher._cache, folder)
    return cast(Callable[..., Any], dispatcher)


def _survive_damage(cache: Any, folder: Path) -> None:
    """Compile again what a cache cannot read, and do without what it cannot write."""
    read, write = cache.load_overload, cache.save_overload

    def load_overload(*arguments: Any) -> Any:
        try:
            return read(*arguments)
        except MemoryError:
            raise
        except Exception as error:  # a pickle that was cut raises errors of many classes
            _LOGGER.warning("%s: the machine code is damaged (%s); compiling it again", folder, type(error).__name__)
            for path in [*folder.rglob("*.nbi"), *folder.rglob("*.nbc"), *folder.glob("*.run")]:
                with suppress(OSError):
                    path.unlink()

    def save_overload(*arguments: Any) -> None:
        try:
            write(*arguments)
        except MemoryError:
            raise
        except Exception as error:  # those of reading too, where a damaged file cannot be deleted
            _tell_once(folder, getattr(error, "strerror", None) or type(error).__name__)

    cache.load_overload, cache.save_overload = load_overload, save_overload


@functools.cache
def _tell_once(folder: Path, reason: str) -> None:
    """Say once in a process that machine code cannot be kept."""
    _LOGGER.warning("%s: cannot be written (%s); kernels are compiled in each process", folder, reason)
