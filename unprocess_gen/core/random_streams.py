"""Named, counted random streams: a random value is a pure function of what it is for.

Every noise value depends on (seed, image, effect, frame, draw, level, y, x) and on nothing else (a fixed pattern on
(seed, profile, sensor unit, effect, y, x)), so no worker, order, crop, tile or skipped effect can move another one.
Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) makes that cheap: it is a keyed
scrambling of a 128-bit counter. Its 64-bit key is hashed from the seed and the image, or the camera body; the rest
stands in the four 32-bit words of the counter:

    word 0   x // 64 * 16 + x % 16      one counter serves the four pixels x, x + 16, x + 32, x + 48 of a block of 64
    word 1   y
    word 2   effect * 2**24 + level * 2**12 + draw
    word 3   frame

Pixel x takes output word x % 64 // 16. The layout does not know the width, and sixteen neighbours come from sixteen
neighbouring counters, which is what vector units want. Tried and dropped: blocks of 1024 pixels vectorise no better
and waste up to three quarters of the work on narrow images.

This room is the readable form (NumPy, about 60 ns a value); `fused` holds the fast one (0.8 ns).
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

STREAMS = {
    "parameters": 0,
    "heteroscedastic": 1,
    "prnu": 2,
    "shot": 3,
    "dark_current": 4,
    "hot_pixels": 5,
    "read": 6,
    "row": 7,
    "column": 8,
    "dead_pixels": 9,
    "dequantize": 10,
    "patch": 11,
}
"""What randomness is for. The numbers are part of every dataset ever made: add, never renumber."""

MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
ROUNDS = 10
BLOCK, LANES = 64, 16
"""Pixels that share a run of counters, and the counters in that run."""

Words = NDArray[np.uint32]


def stream_key(seed: int, source_sha256: str, occurrence: int = 0) -> int:
    """Return the 64-bit key of an image's streams.

    ``source_sha256`` is the hex digest of the source's bytes, ``occurrence`` the number of identical files before it
    in the listing: adding or dropping other files moves nothing.
    """
    name = f"unprocess_gen stream 1\0{seed}\0{source_sha256}\0{occurrence}"
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")


def body_key(seed: int, profile: str, unit: str) -> int:
    """Return the 64-bit key of a camera body's fixed patterns: the same for every frame that this body takes."""
    name = f"unprocess_gen body 1\0{seed}\0{profile}\0{unit}"
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")


def purpose(stream: str, level: int = 0, draw: int = 0) -> int:
    """Return word 2 of the counter; ValueError for a level or draw outside 0 … 4095."""
    if not (0 <= level < 4096 and 0 <= draw < 4096):
        raise ValueError(f"level and draw are {level} and {draw}, expected 0 to 4095")
    return STREAMS[stream] << 24 | level << 12 | draw


def philox4x32(counter: tuple[NDArray[np.uint64], ...], key: int) -> tuple[Words, Words, Words, Words]:
    """Return the four output words of Philox4x32-10 for counters given as four broadcastable arrays of 32-bit words.

    Known answers: the vectors published with Random123 (``kat_vectors``).
    """
    low, shift = np.uint64(0xFFFFFFFF), np.uint64(32)
    m0, m1 = (np.uint64(multiplier) for multiplier in MULTIPLIERS)
    k0, k1 = key & 0xFFFFFFFF, key >> 32
    c0, c1, c2, c3 = counter
    for _ in range(ROUNDS):
        p0, p1 = m0 * c0, m1 * c2
        c0, c1 = (p1 >> shift) ^ c1 ^ np.uint64(k0), p1 & low
        c2, c3 = (p0 >> shift) ^ c3 ^ np.uint64(k1), p0 & low
        k0, k1 = (k0 + KEY_STEPS[0]) & 0xFFFFFFFF, (k1 + KEY_STEPS[1]) & 0xFFFFFFFF
    w0, w1, w2, w3 = (word.astype(np.uint32) for word in np.broadcast_arrays(c0, c1, c2, c3))
    return w0, w1, w2, w3


def words(
    key: int,
    stream: str,
    shape: tuple[int, int],
    *,
    origin: tuple[int, int] = (0, 0),
    frame: int = 0,
    level: int = 0,
    draw: int = 0,
) -> Words:
    """Return one uint32 per pixel of a tile ``[H, W]`` whose top-left pixel is ``origin`` in the full frame."""
    y = np.arange(origin[0], origin[0] + shape[0], dtype=np.uint64)[:, None]
    x = np.arange(origin[1], origin[1] + shape[1], dtype=np.uint64)[None, :]
    block, lane, lanes = np.uint64(BLOCK), x % np.uint64(LANES), np.uint64(LANES)
    counter = (x // block * lanes + lane, y, np.uint64(purpose(stream, level, draw)), np.uint64(frame))
    outputs = philox4x32(tuple(np.asarray(word) for word in counter), key)
    chosen = np.broadcast_to((x % block // lanes).astype(np.intp), shape)
    return np.asarray(np.choose(chosen, outputs), dtype=np.uint32)


def patch_words(key: int, count: int) -> list[tuple[int, int]]:
    """Return two words of 32 bits for each of the first ``count`` patches of one image.

    Patch n is counter (0, n) of the stream ``patch``, so that more patches leave the first ones where they are.
    """
    zero = np.zeros(count, dtype=np.uint64)
    counter = (zero, np.arange(count, dtype=np.uint64), zero + np.uint64(purpose("patch")), zero)
    first, second, _, _ = philox4x32(counter, key)
    return list(zip(first.tolist(), second.tolist(), strict=True))


def parameter_uniforms(key: int, count: int, level: int = 0) -> list[float]:
    """Return ``count`` uniforms in (0, 1) with 52 bits each, (k + ½)·2**-52, for the parameters of one image.

    Parameter n is counter (0, n) of the stream ``parameters``: its number is its name, so add, never renumber.
    """
    zero = np.zeros(count, dtype=np.uint64)
    counter = (zero, np.arange(count, dtype=np.uint64), zero + np.uint64(purpose("parameters", level)), zero)
    high, low, _, _ = philox4x32(counter, key)
    bits = [(int(h) << 20) | (int(w) >> 12) for h, w in zip(high, low, strict=True)]
    return [(k + 0.5) * 2.0**-52 for k in bits]
