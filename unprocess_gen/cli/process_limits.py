"""Check limits of the process before numpy, numba and OpenCV are loaded."""

from __future__ import annotations

import os
import sys

from unprocess_gen.core.errors import MachineError

if sys.platform != "win32":
    import resource

LEAST_ADDRESS_SPACE = 2**30
"""Bytes of ``ulimit -v`` below which libraries crash instead of raising MemoryError.

Without the check, numpy's OpenBLAS and LLVM end the process with a segmentation fault or a page of tracebacks."""


def prepare_libraries() -> None:
    """Limit OpenBLAS to one thread, which reserves less address space; no code here calls it.

    Raises
    ------
    MachineError
        If ``ulimit -v`` is below `LEAST_ADDRESS_SPACE`.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if sys.platform != "win32":
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESS_SPACE:
            raise MachineError(
                f"ulimit -v {limit // 1024}: not enough address space; expected at least "
                f"{LEAST_ADDRESS_SPACE // 1024} (KiB); raise the limit"
            )
