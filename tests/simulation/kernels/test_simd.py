"""Test vectors and pointers: compiled functions give the same bytes as their NumPy implementations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
import pytest

from unprocess_gen.core.jit import kernel
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    absolute,
    from_bits,
    less_than,
    load,
    load_columns,
    maximum,
    minimum,
    movemask,
    pointer_to,
    pointers_of,
    select,
    square_root,
    store,
    to_bits,
    to_float32,
    to_float64,
    to_uint32,
    to_uint64,
)

SINGLES = np.array([-np.inf, -1.5, -0.0, 0.0, 1e-40, 2.5, 7.25, np.inf], dtype=np.float32)
OTHERS = np.array([3.0, -1.5, 0.0, -0.0, 1e-38, 0.1, -7.25, 1.0], dtype=np.float32)
WORDS = np.array([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 12345, 2**24 + 1, 77], dtype=np.uint32)
NUMBER, TWO, ZERO = np.float32(0.3), np.float32(2), np.float32(0)
_32, _EVERY_BIT = np.uint64(32), np.uint64(2**64 - 1)
SHIFT, MASK = np.uint32(9), np.uint32(0x7FFFFFFF)


@kernel
def _arithmetic(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    a, b, target = load(pointer_to(x, 0), 0), load(pointer_to(y, 0), 0), pointer_to(out, 0)
    store(target, 0, a + b)
    store(target, 8, a - b)
    store(target, 16, a * b)
    store(target, 24, NUMBER * b + a * TWO)
    store(target, 32, maximum(a, b))
    store(target, 40, minimum(a, NUMBER))
    store(target, 48, square_root(maximum(a, ZERO)))
    store(target, 56, a / maximum(b, NUMBER))


@kernel
def _bits(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    a, b, target = load(pointer_to(x, 0), 0), load(pointer_to(y, 0), 0), pointer_to(out, 0)
    store(target, 0, (b & MASK) ^ to_bits(a))
    store(target, 8, (b >> SHIFT) | (b << SHIFT))
    store(target, 16, less_than(a, NUMBER))
    store(target, 24, to_bits(to_float32(b & MASK)))
    store(target, 32, to_uint32(to_float32(b & MASK) * NUMBER))
    store(target, 40, to_bits(from_bits(b ^ b)) + b)


@kernel
def _float64(x: np.ndarray, out: np.ndarray) -> None:
    a, target = load(pointer_to(x, 0), 0), pointer_to(out, 0)
    store(target, 0, to_float32(a))
    store(target, 8, to_float32((a * 1e10 + 6755399441055744.0) - 6755399441055744.0))


@kernel
def _masks(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    a, b, target = load(pointer_to(x, 0), 0), load(pointer_to(y, 0), 0), pointer_to(out, 0)
    target[0] = movemask(b)
    target[1] = movemask(less_than(a, a * TWO))
    target[2] = movemask(less_than(ZERO, a))
    target[3] = movemask(less_than(b, MASK))
    store(target, 8, less_than(SHIFT, b))


@kernel
def _uint16(x: np.ndarray, out: np.ndarray) -> None:
    store(pointer_to(out, 3), 0, load(pointer_to(x, 0), 0))


@kernel
def _scalars(codes: np.ndarray, wide: np.ndarray, out: np.ndarray) -> None:
    from_second, target = pointer_to(codes, 3), pointer_to(out, 0)
    for at in range(3):
        target[at] = from_second[at]
    numbers = pointer_to(pointer_to(wide, 1), 1)
    target[3] = numbers[np.uint16(40000)]


@kernel
def _wide(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    a, b, target = load(pointer_to(x, 0), 0), load(pointer_to(y, 0), 0), pointer_to(out, 0)
    store(target, 0, to_float64(a))
    store(target, 8, to_float64(a) * to_float64(b) + 0.1)
    store(target, 16, square_root(maximum(to_float64(b), 0.1)) / minimum(to_float64(a), 1e300))
    store(target, 24, to_float64(absolute(a)))
    store(target, 32, to_float64(select(less_than(a, b), a, b)))
    store(target, 40, select(less_than(to_float64(a), 0.5) ^ _EVERY_BIT, to_float64(b), to_float64(a)))


@kernel
def _halves(x: np.ndarray, out: np.ndarray) -> None:
    a, target = load(pointer_to(x, 0), 0), pointer_to(out, 0)
    store(target, 0, to_uint32(a))
    store(target, 8, to_uint32(a >> _32))
    store(target, 16, select(less_than(from_bits(to_uint32(a)), NUMBER), to_uint32(a >> _32), to_uint32(a)))
    target[24] = movemask(less_than(to_float64(from_bits(to_uint32(a))), 0.5))


@kernel
def _columns(table: np.ndarray, starts: np.ndarray, out: np.ndarray) -> None:
    target = pointer_to(out, 0)
    first, second, third = load_columns(pointer_to(table, 0), pointer_to(starts, 0), 1)
    store(target, 0, first)
    store(target, 8, second)
    store(target, 16, third)


@kernel
def _uint64(x: np.ndarray, out: np.ndarray) -> None:
    a, target = load(pointer_to(x, 0), 0), pointer_to(out, 0)
    store(target, 0, to_uint64(a) << _32 | to_uint64(a >> SHIFT))
    store(target, 8, to_bits(from_bits(to_uint64(a) << _32) * 0.5))
    store(target, 16, to_bits(to_float64(a & MASK) + 0.5))


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


def record() -> Record:
    """Return a record of arrays of one and of two dimensions, with one inside."""
    doubles = np.arange(12, dtype=np.float64)
    return Record(doubles.reshape(3, 4) * 2, Inside(doubles + 0.5, 3.0), doubles.reshape(2, 6) * -1, 40, (5, 6))


LONG_WORDS = np.array(
    [0, 1, 2**32 - 1, 2**32, 2**63, 2**64 - 1, 0x3F800000_BF000000, 0x0123456789ABCDEF], dtype=np.uint64
)
STARTS = np.array([7, 999, 0, 3, 3, 512, 40, 998, 1], dtype=np.uint32)
DOUBLES = np.array([1.1, -2.5e-11, 2.5e-10, 3.5e-10, 1e300, -0.0, 12345.678901234, 0.5e-10])
CASES: dict[str, tuple[Any, tuple[np.ndarray, ...], np.ndarray]] = {
    "arithmetic": (_arithmetic, (SINGLES, OTHERS), np.zeros(64, dtype=np.float32)),
    "bits": (_bits, (SINGLES, WORDS), np.zeros(48, dtype=np.uint32)),
    "float64": (_float64, (DOUBLES,), np.zeros(16, dtype=np.float32)),
    "wide": (_wide, (SINGLES, OTHERS), np.zeros(48)),
    "halves": (_halves, (LONG_WORDS,), np.zeros(25, dtype=np.uint32)),
    "columns": (_columns, (np.arange(4000) * 0.1, 4 * STARTS), np.zeros(24)),
    "uint64": (_uint64, (WORDS,), np.zeros(24, dtype=np.uint64)),
    "masks": (_masks, (OTHERS, WORDS), np.zeros(16, dtype=np.uint32)),
    "uint16": (_uint16, (WORDS,), np.zeros(12, dtype=np.uint16)),
    "scalars": (
        _scalars,
        (np.arange(200, 212, dtype=np.uint8).reshape(2, 2, 3), np.arange(50000, dtype=np.uint32)),
        np.zeros(4, dtype=np.uint32),
    ),
}


def uncompiled(kernel_function: Any) -> Callable[..., None]:
    return cast(Callable[..., None], getattr(kernel_function, "py_func", kernel_function))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.filterwarnings("ignore:overflow")
def test_compiled_vectors_equal_numpy_implementation(case: str) -> None:
    kernel_function, arguments, empty = CASES[case]
    compiled, expected = empty.copy(), empty.copy()

    kernel_function(*arguments, compiled)
    with np.errstate(all="ignore"):
        uncompiled(kernel_function)(*arguments, expected)

    assert compiled.tobytes() == expected.tobytes()
    assert compiled.tobytes() != empty.tobytes()


def test_first_lane_is_lowest_bit_of_mask() -> None:
    out = np.zeros(16, dtype=np.uint32)
    _masks(OTHERS, WORDS, out)
    assert out[:3].tolist() == [0b00011000, 0b10110001, 0b10110001]
    assert VECTOR_WIDTH == 8


def test_integers_are_compared_without_sign() -> None:
    out = np.zeros(16, dtype=np.uint32)
    _masks(OTHERS, WORDS, out)
    assert out[3] == 0b11100011
    assert (out[8:] == np.where(WORDS > SHIFT, 2**32 - 1, 0)).all()


def test_store_truncates_to_16_bits_and_writes_eight_values_only() -> None:
    out = np.full(12, 7, dtype=np.uint16)
    _uint16(WORDS, out)
    assert out.tolist() == [7, 7, 7, *(int(word) % 2**16 for word in WORDS), 7]


def test_index_of_16_bits_is_unsigned() -> None:
    out = np.zeros(4, dtype=np.uint32)
    _scalars(*CASES["scalars"][1], out)
    assert out.tolist() == [203, 204, 205, 40002]


def test_select_takes_lanes_of_set_masks() -> None:
    out = np.zeros(48)
    _wide(SINGLES, OTHERS, out)
    is_less = SINGLES < OTHERS
    assert out[32:40].tolist() == np.where(is_less, SINGLES, OTHERS).tolist()
    assert out[40:].tolist() == np.where(SINGLES >= 0.5, OTHERS, SINGLES).tolist()
    assert 0 < is_less.sum() < VECTOR_WIDTH


def test_absolute_clears_the_sign_of_zero_and_infinity() -> None:
    out = np.zeros(48)
    _wide(SINGLES, OTHERS, out)
    assert out[24:32].tobytes() == np.abs(SINGLES.astype(np.float64)).tobytes()
    assert not np.signbit(out[24:32]).any()


def test_columns_are_those_of_the_rows_that_begin_there() -> None:
    out = np.zeros(24)
    _columns(*CASES["columns"][1], out)
    assert np.array_equal(out.reshape(3, 8), (np.arange(4000) * 0.1).reshape(1000, 4)[STARTS[1:], :3].T)


def test_conversion_to_uint32_drops_the_high_bits() -> None:
    out = np.zeros(25, dtype=np.uint32)
    _halves(LONG_WORDS, out)
    assert out[:8].tolist() == [int(word) % 2**32 for word in LONG_WORDS]
    assert out[8:16].tolist() == [int(word) >> 32 for word in LONG_WORDS]


@pytest.mark.parametrize("form", [_record, _record.py_func], ids=["compiled", "uncompiled"])  # type: ignore[attr-defined]
def test_pointers_of_a_record_reach_all_arrays(form: Callable[..., None]) -> None:
    """Numbers and tuples are copied, arrays are not."""
    given, out = record(), np.zeros(13)
    form(given, out)
    assert out[:5].tolist() == [6.0, 4.5, -4.0, 46.0, 99.0]
    assert out[5:].tolist() == [2.5 + n + 2 * n for n in range(8)]
    assert given.second[0, 5] == 99.0
