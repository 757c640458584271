"""Vectors: what is compiled computes as the arrays do that kernels see where nothing is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest

from unprocess_gen.core.jit import kernel
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    from_bits,
    less_than,
    load,
    load_four_bytes,
    maximum,
    minimum,
    movemask,
    pointer_to,
    square_root,
    store,
    to_bits,
    to_float32,
    to_uint32,
    uint32_zeros,
)

SINGLES = np.array([-np.inf, -1.5, -0.0, 0.0, 1e-40, 2.5, 7.25, np.inf], dtype=np.float32)
OTHERS = np.array([3.0, -1.5, 0.0, -0.0, 1e-38, 0.1, -7.25, 1.0], dtype=np.float32)
WORDS = np.array([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 12345, 2**24 + 1, 77], dtype=np.uint32)
NUMBER, TWO, ZERO = np.float32(0.3), np.float32(2), np.float32(0)
SHIFT, MASK = np.uint32(9), np.uint32(0x7FFFFFFF)


@kernel
def _arithmetic(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    a, b, made = load(pointer_to(x, 0), 0), load(pointer_to(y, 0), 0), pointer_to(out, 0)
    store(made, 0, a + b)
    store(made, 8, a - b)
    store(made, 16, a * b)
    store(made, 24, NUMBER * b + a * TWO)
    store(made, 32, maximum(a, b))
    store(made, 40, minimum(a, NUMBER))
    store(made, 48, square_root(maximum(a, ZERO)))
    store(made, 56, a / maximum(b, NUMBER))


@kernel
def _bits(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    a, b, made = load(pointer_to(x, 0), 0), load(pointer_to(y, 0), 0), pointer_to(out, 0)
    store(made, 0, (b & MASK) ^ to_bits(a))
    store(made, 8, (b >> SHIFT) | (b << SHIFT))
    store(made, 16, less_than(a, NUMBER))
    store(made, 24, to_bits(to_float32(b & MASK)))
    store(made, 32, to_uint32(to_float32(b & MASK) * NUMBER))
    store(made, 40, to_bits(from_bits(b ^ b)) + uint32_zeros() + b)


@kernel
def _doubles(x: np.ndarray, out: np.ndarray) -> None:
    a, made = load(pointer_to(x, 0), 0), pointer_to(out, 0)
    store(made, 0, to_float32(a))
    store(made, 8, to_float32((a * 1e10 + 6755399441055744.0) - 6755399441055744.0))


@kernel
def _masks(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    a, b, made = load(pointer_to(x, 0), 0), load(pointer_to(y, 0), 0), pointer_to(out, 0)
    made[0] = movemask(b)
    made[1] = movemask(less_than(a, a * TWO))
    made[2] = movemask(less_than(ZERO, a))


@kernel
def _halves(x: np.ndarray, out: np.ndarray) -> None:
    store(pointer_to(out, 3), 0, load(pointer_to(x, 0), 0))


@kernel
def _one_by_one(codes: np.ndarray, wide: np.ndarray, out: np.ndarray) -> None:
    from_second, made = pointer_to(codes, 3), pointer_to(out, 0)
    made[0] = load_four_bytes(from_second, np.uint64(2))
    for at in range(3):
        made[1 + at] = from_second[at]
    numbers = pointer_to(pointer_to(wide, 1), 1)
    made[4] = numbers[np.uint16(40000)]


DOUBLES = np.array([1.1, -2.5e-11, 2.5e-10, 3.5e-10, 1e300, -0.0, 12345.678901234, 0.5e-10])
CASES: dict[str, tuple[Any, tuple[np.ndarray, ...], np.ndarray]] = {
    "arithmetic": (_arithmetic, (SINGLES, OTHERS), np.zeros(64, dtype=np.float32)),
    "bits": (_bits, (SINGLES, WORDS), np.zeros(48, dtype=np.uint32)),
    "doubles": (_doubles, (DOUBLES,), np.zeros(16, dtype=np.float32)),
    "masks": (_masks, (OTHERS, WORDS), np.zeros(3, dtype=np.uint32)),
    "halves": (_halves, (WORDS,), np.zeros(12, dtype=np.uint16)),
    "one by one": (
        _one_by_one,
        (np.arange(200, 212, dtype=np.uint8).reshape(2, 2, 3), np.arange(50000, dtype=np.uint32)),
        np.zeros(5, dtype=np.uint32),
    ),
}


def uncompiled(made_of: Any) -> Callable[..., None]:
    return cast(Callable[..., None], getattr(made_of, "py_func", made_of))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.filterwarnings("ignore:overflow")
def test_vectors_hold_what_arrays_hold(case: str) -> None:
    made_of, given, room = CASES[case]
    compiled, plain = room.copy(), room.copy()

    made_of(*given, compiled)
    with np.errstate(all="ignore"):
        uncompiled(made_of)(*given, plain)

    assert compiled.tobytes() == plain.tobytes()
    assert compiled.tobytes() != room.tobytes()


def test_a_mask_has_the_first_lane_lowest() -> None:
    out = np.zeros(3, dtype=np.uint32)
    _masks(OTHERS, WORDS, out)
    assert out.tolist() == [0b00011000, 0b10110001, 0b10110001]
    assert VECTOR_WIDTH == 8


def test_low_halves_are_stored_among_numbers_of_16_bits_and_nothing_beside_them() -> None:
    out = np.full(12, 7, dtype=np.uint16)
    _halves(WORDS, out)
    assert out.tolist() == [7, 7, 7, *(int(word) % 2**16 for word in WORDS), 7]


def test_an_index_of_16_bits_has_no_sign() -> None:
    out = np.zeros(5, dtype=np.uint32)
    _one_by_one(*CASES["one by one"][1], out)
    assert out.tolist() == [0xD0CFCECD, 203, 204, 205, 40002]
