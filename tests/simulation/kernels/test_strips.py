"""Check the scratch memory of strips."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.simulation.kernels.jit import kernel
from unprocess_gen.simulation.kernels.strips import (
    CACHE_LINE,
    SIZE,
    Buffers,
    Scratch,
    allocate_scratch,
    buffers_in,
)


@kernel
def _mark(scratch: Scratch, first: int, last: int) -> None:
    """Write to the ends of buffers of each dtype, and of the first and the last one."""
    buffers = buffers_in(scratch)
    for n in (first, last):
        buffers.signal[n] = 1.5
        buffers.exact_dn[n] = 2.5
        buffers.rounded_dn[n] = np.float32(3.5)
        buffers.words[n] = np.uint32(4)
        buffers.lines[n] = np.uint64(2**40)
        buffers.noisy[n] = np.uint16(5)


MARKED = {"signal": 1.5, "exact_dn": 2.5, "rounded_dn": 3.5, "words": 4, "lines": 2**40, "noisy": 5}
TABLES = ("lanes_by_mask", "count_by_mask")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_compiled_buffers_are_those_of_python(dtype: Any) -> None:
    scratch = allocate_scratch(dtype)
    before = {name: getattr(buffers_in(scratch), name).copy() for name in TABLES}

    _mark(scratch, 0, SIZE - 1)

    for name, buffer in buffers_in(scratch)._asdict().items():
        if name in TABLES:
            assert (buffer == before[name]).all()
        else:
            expected = np.zeros(SIZE)
            expected[[0, -1]] = MARKED.get(name, 0)
            assert (buffer[:SIZE] == expected).all(), name


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_buffers_are_aligned_and_a_block_apart(dtype: Any) -> None:
    """Random words begin up to a block before the first element."""
    buffers = buffers_in(allocate_scratch(dtype))

    starts = [buffer.ctypes.data for buffer in buffers]
    assert len(starts) == len(Buffers._fields)
    assert not any(start % CACHE_LINE for start in starts)
    for buffer, after, following in zip(buffers[:-1], starts[1:], buffers[1:], strict=True):
        assert buffer.ctypes.data + SIZE * buffer.itemsize <= after - BLOCK * following.itemsize


def test_words_before_the_first_element_leave_other_buffers_alone() -> None:
    scratch = allocate_scratch()

    _mark(scratch, -BLOCK, -BLOCK)

    for name, buffer in buffers_in(scratch)._asdict().items():
        assert name in TABLES or not buffer[:SIZE].any()
