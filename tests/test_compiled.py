"""Kernels that only kernels call: made machine code where they are called, and kept between processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from unprocess_gen.compiled import inner, is_kept, kernel


@inner
def _square(x: float) -> float:
    return x * x


@kernel
def _squares(x: np.ndarray, out: np.ndarray) -> None:
    for n in range(out.shape[0]):
        out[n] = _square(x[n])


def test_a_kernel_that_only_kernels_call_is_made_machine_code_in_them_alone() -> None:
    x, out = np.arange(9.0), np.empty(9)
    _squares(x, out)

    defined = ["".join(cast(Any, one).inspect_llvm().values()).count("\ndefine") for one in (_square, _squares)]
    assert (out == x * x).all()
    assert cast(Any, _square).signatures
    assert defined[0] == 0 < defined[1]


ROOM = """
from unprocess_gen.compiled import inner, kernel

@inner
def half(x):
    return x / 2

@inner
def quarter(x):
    return half(half(x))

@kernel
def first(x):
    return quarter(x) + 1

@kernel
def second(x):
    return quarter(x) + 2

@kernel
def third(x):
    return half(x)
"""


def test_what_a_process_compiled_another_takes_into_other_kernels(tmp_path: Path) -> None:
    (tmp_path / "room.py").write_text(ROOM)
    told = "print({call}, *(len(one.stats.cache_hits) for one in (room.half, room.quarter, room.{kernel})))"

    def process(kernel: str) -> str:
        code = "import room; " + told.format(call=f"room.{kernel}(8.0)", kernel=kernel)
        path = f"{tmp_path}:{Path(__file__).parents[1]}"
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command,
            env={"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    assert process("first") == "3.0 0 0 0"
    assert process("second") == "4.0 0 1 0"
    assert process("third") == "4.0 1 0 0"
    assert process("first") == "3.0 0 0 1"


def test_a_kernel_that_this_process_has_compiled_is_at_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cast(Any, _never)._cache._cache_file, "_load_index", dict)  # as if none were kept
    assert not is_kept(_never)
    _never(np.zeros(1))
    assert is_kept(_never)


@kernel
def _never(x: np.ndarray) -> None:
    x[0] = 1.0
