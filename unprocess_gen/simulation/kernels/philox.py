"""Generate counter-based random words in kernels: Philox4x32-10 in the layout of `core.random_streams`.

The values equal `core.random_streams.words`; tests compare them with Random123's known answers. Each word
depends only on its key and counter, so strips, workers and crops cannot change it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.random_streams import BLOCK, KEY_STEPS, LANES, LOW, MULTIPLIERS, ROUNDS
from unprocess_gen.simulation.kernels.jit import inner
from unprocess_gen.simulation.kernels.simd import Pointer
from unprocess_gen.simulation.kernels.strips import Strip
from unprocess_gen.simulation.plan import Plan

LOW32, _32, _LANES = np.uint64(LOW), np.uint64(32), np.uint64(LANES)
KEY_STEP0, KEY_STEP1 = (np.uint64(step) for step in KEY_STEPS)
_M0, _M1 = (np.uint64(multiplier) for multiplier in MULTIPLIERS)

PhiloxKey = tuple[np.uint64, np.uint64, np.uint64, np.uint64]
"""Two 32-bit words of the key, then two words that go into the counter: level and draw, and frame and epoch."""

_CounterBlock = tuple[np.uint64, np.uint64, np.uint64, np.uint64]


def philox_key(key: int) -> PhiloxKey:
    """Return the 64-bit key of a sensor unit's patterns as kernels take it: level, draw, frame and epoch are 0."""
    return np.uint64(key & LOW), np.uint64(key >> 32), np.uint64(0), np.uint64(0)


def philox_keys(plans: Sequence[Plan]) -> NDArray[np.uint64]:
    """Return the key and counter words of several plans, uint64 ``[N, 4]``; `load_key` reads one row."""
    rows = [
        (plan.stream_key & LOW, plan.stream_key >> 32, plan.place.level << 12 | plan.place.draw, plan.place.frame_word)
        for plan in plans
    ]
    return np.array(rows, dtype=np.uint64)


@inner
def load_key(keys: Pointer, plan: int) -> PhiloxKey:
    """Return row ``plan`` of the array that `philox_keys` made."""
    return keys[4 * plan], keys[4 * plan + 1], keys[4 * plan + 2], keys[4 * plan + 3]


@inner
def philox_round(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> _CounterBlock:
    """Compute one round of Philox4x32 on four words, each in the low half of a uint64; high halves are ignored.

    Vector units multiply only the low halves, so masking before a product is free. Callers contain the loop over
    rounds: LLVM neither inlines nor vectorises a function that contains it.
    """
    p0 = _M0 * (c0 & LOW32)
    p1 = _M1 * (c2 & LOW32)
    return (p1 >> _32) ^ (c1 ^ k0), p1, (p0 >> _32) ^ (c3 ^ k1), p0


@inner
def first_word(key: PhiloxKey, row: np.uint64, purpose_word: np.uint64) -> np.uint32:
    """Return the word of column 0 of a row of the full frame."""
    c0, c1, c2, c3 = np.uint64(0), row, purpose_word | key[2], key[3]
    k0, k1 = key[0], key[1]
    for _ in range(ROUNDS):
        c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
        k0, k1 = (k0 + KEY_STEP0) & LOW32, (k1 + KEY_STEP1) & LOW32
    return np.uint32(c0 & LOW32)


@inner
def fill_word_blocks(key: PhiloxKey, strip: Strip, purpose_word: np.uint64, out: Pointer) -> None:
    """Fill ``out`` (uint32) with one word per pixel, for the complete blocks of a strip, from index -`lead` on."""
    for block in range(strip.blocks):
        counter = (strip.block + np.uint64(block)) * _LANES
        first = block * BLOCK - strip.lead
        for lane in range(LANES):
            c0, c1, c2, c3 = counter + np.uint64(lane), strip.row, purpose_word | key[2], key[3]
            k0, k1 = key[0], key[1]
            for _ in range(ROUNDS):
                c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
                k0, k1 = (k0 + KEY_STEP0) & LOW32, (k1 + KEY_STEP1) & LOW32
            out[first + lane] = np.uint32(c0 & LOW32)
            out[first + LANES + lane] = np.uint32(c1 & LOW32)
            out[first + 2 * LANES + lane] = np.uint32(c2 & LOW32)
            out[first + 3 * LANES + lane] = np.uint32(c3 & LOW32)
