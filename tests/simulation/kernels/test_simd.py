"""Test vectors and pointers: compiled functions give the same bytes as their NumPy implementations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from unprocess_gen.simulation.kernels import simd
from unprocess_gen.simulation.kernels.jit import inner, kernel
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, load, load_columns, pointer_to, pointers_of, store

SINGLES = np.array([-np.inf, -1.5, -0.0, 0.0, 1e-40, 2.5, 7.25, np.inf], dtype=np.float32)
OTHERS = np.array([3.0, -1.5, 0.0, -0.0, 1e-38, 0.1, -7.25, 1.0], dtype=np.float32)
DOUBLES = np.array([1.1, -2.5e-11, 2.5e-10, 3.5e-10, 1e300, -0.0, 12345.678901234, 0.5e-10])
WORDS = np.array([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 12345, 2**24 + 1, 77], dtype=np.uint32)
LONG_WORDS = np.array(
    [0, 1, 2**32 - 1, 2**32, 2**63, 2**64 - 1, 0x3F800000_BF000000, 0x0123456789ABCDEF], dtype=np.uint64
)
NUMBER, ZERO = np.float32(0.3), np.float32(0)
SHIFT, MASK, _32 = np.uint32(9), np.uint32(0x7FFFFFFF), np.uint64(32)

OPERATIONS: dict[str, tuple[Any, ...]] = {
    "add": (lambda a, b: a + b, SINGLES, OTHERS),
    "subtract": (lambda a, b: a - b, SINGLES, OTHERS),
    "multiply and add": (lambda a, b: NUMBER * b + a * NUMBER, SINGLES, OTHERS),
    "divide": (lambda a, b: a / simd.maximum(b, NUMBER), SINGLES, OTHERS),
    "minimum": (lambda a, b: simd.minimum(a, NUMBER) + simd.maximum(a, b), SINGLES, OTHERS),
    "square root": (lambda a, b: simd.square_root(simd.maximum(a, ZERO)) + simd.absolute(b), SINGLES, OTHERS),
    "logic": (lambda a, b: (b & MASK) ^ simd.to_bits(a), SINGLES, WORDS),
    "shift": (lambda b: (b >> SHIFT) | (b << SHIFT), WORDS),
    "less than": (lambda a, b: simd.less_than(a, b), SINGLES, OTHERS),
    "less than, words": (lambda b: simd.less_than(SHIFT, b), WORDS),
    "words to float32": (lambda b: simd.to_float32(b & MASK) * NUMBER, WORDS),
    "float32 to words": (lambda b: simd.to_uint32(simd.to_float32(b & MASK)), WORDS),
    "bits": (lambda b: simd.to_bits(simd.from_bits(b ^ b)) + b, WORDS),
    "float64 to float32": (lambda a: simd.to_float32(a * 1e10), DOUBLES),
    "float64": (lambda a, b: simd.to_float64(a) * simd.to_float64(b) + 0.1, SINGLES, OTHERS),
    "select": (lambda a, b: simd.select(simd.less_than(a, b), a, b), SINGLES, OTHERS),
    "high and low words": (lambda a: simd.to_uint32(a >> _32) ^ simd.to_uint32(a), LONG_WORDS),
    "words to uint64": (lambda a: simd.to_uint64(a) << _32 | simd.to_uint64(a >> SHIFT), WORDS),
    "words to float64": (lambda a: simd.to_bits(simd.to_float64(a & MASK) + 0.5), WORDS),
}


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid")
def test_compiled_operations_equal_numpy(name: str) -> None:
    function, *operands = OPERATIONS[name]
    compiled = inner(function)

    @kernel
    def of_one(x: np.ndarray, out: np.ndarray) -> None:
        store(pointer_to(out, 0), 0, compiled(load(pointer_to(x, 0), 0)))

    @kernel
    def of_two(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
        store(pointer_to(out, 0), 0, compiled(load(pointer_to(x, 0), 0), load(pointer_to(y, 0), 0)))

    with np.errstate(all="ignore"):
        expected = function(*operands)
    out = np.zeros_like(expected)
    (of_one if len(operands) == 1 else of_two)(*operands, out)
    assert out.tobytes() == expected.tobytes()


@kernel
def _masks(x: np.ndarray, out: np.ndarray) -> None:
    a, target = load(pointer_to(x, 0), 0), pointer_to(out, 0)
    target[0], target[1] = simd.movemask(a), simd.movemask(simd.less_than(a, MASK))
    target[2], target[3] = np.uint32(simd.has_any_bit(a)), np.uint32(simd.has_any_bit(a ^ a))


def test_first_lane_is_lowest_bit_of_mask() -> None:
    """Integers are compared without sign."""
    for form in (_masks, _masks.py_func):  # type: ignore[attr-defined]
        out = np.zeros(4, dtype=np.uint32)
        form(WORDS, out)
        assert out.tolist() == [0b00011000, 0b11100011, 1, 0]
    assert VECTOR_WIDTH == 8


@kernel
def _uint16(x: np.ndarray, out: np.ndarray) -> None:
    store(pointer_to(out, 3), 0, load(pointer_to(x, 0), 0))


def test_store_truncates_to_16_bits_and_writes_eight_values_only() -> None:
    out = np.full(12, 7, dtype=np.uint16)
    _uint16(WORDS, out)
    assert out.tolist() == [7, 7, 7, *(int(word) % 2**16 for word in WORDS), 7]


@kernel
def _columns(table: np.ndarray, starts: np.ndarray, out: np.ndarray) -> None:
    first, second, third = load_columns(pointer_to(table, 0), pointer_to(starts, 0), 1)
    store(pointer_to(out, 0), 0, first)
    store(pointer_to(out, 0), 8, second)
    store(pointer_to(out, 0), 16, third)


def test_columns_are_those_of_the_rows_that_begin_there() -> None:
    table, rows = np.arange(4000) * 0.1, np.array([7, 999, 0, 3, 3, 512, 40, 998, 1], dtype=np.uint32)
    for form in (_columns, _columns.py_func):  # type: ignore[attr-defined]
        out = np.zeros(24)
        form(table, 4 * rows, out)
        assert np.array_equal(out.reshape(3, 8), table.reshape(1000, 4)[rows[1:], :3].T)


class Inside(NamedTuple):
    values: np.ndarray
    factor: float


class Record(NamedTuple):
    first: np.ndarray
    inside: Inside
    second: np.ndarray
    count: int
    steps: tuple[int, int]


@kernel
def _record(record: Record, out: np.ndarray) -> None:
    pointers, target = pointers_of(record), pointer_to(out, 0)
    target[0] = pointers.first[3]
    target[1] = pointers.inside.values[1] * pointers.inside.factor
    target[2] = pointers.second[np.uint64(4)]
    target[3] = pointers.count + pointers.steps[1]
    pointers.second[5] = 99.0
    again = pointers_of(pointers)
    target[4] = again.second[5]
    store(target, 5, load(pointers.inside.values, 2) + load(again.first, 0))


@pytest.mark.parametrize("form", [_record, _record.py_func], ids=["compiled", "uncompiled"])  # type: ignore[attr-defined]
def test_pointers_of_a_record_reach_all_arrays(form: Callable[..., None]) -> None:
    """Numbers and tuples are copied, arrays are not."""
    doubles, out = np.arange(12, dtype=np.float64), np.zeros(13)
    given = Record(doubles.reshape(3, 4) * 2, Inside(doubles + 0.5, 3.0), doubles.reshape(2, 6) * -1, 40, (5, 6))
    form(given, out)
    assert out[:5].tolist() == [6.0, 4.5, -4.0, 46.0, 99.0]
    assert out[5:].tolist() == [2.5 + n + 2 * n for n in range(8)]
    assert given.second[0, 5] == 99.0
