"""Random numbers as pure functions of their purpose: counter-based streams with Philox4x32-10.

A noise value depends only on (seed, image, effect, epoch, frame, draw, level, y, x). A fixed pattern depends only on
(seed, profile, sensor unit, effect, y, x). Therefore no worker, order, crop, tile or omitted effect can change another
value.

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) scrambles a 128-bit counter with a
64-bit key. The key is a hash of the seed and the image, or of the camera body. The four words of the counter are:

    word 0   x // 64 * 16 + x % 16      one counter serves the pixels x, x + 16, x + 32, x + 48 of a block of 64
    word 1   y
    word 2   effect * 2**24 + level * 2**12 + draw
    word 3   epoch * 2**18 + frame

Pixel x takes output word x % 64 // 16. The layout does not depend on the image width, and 16 neighbouring pixels use 16
consecutive counters, which vectorises. The epoch is 0 in every stored dataset; live pairs have others. Alternatives:
``docs/design/random_numbers.md``.

This module is the NumPy reference; `simulation.kernels.philox` and `draws` contain the compiled form.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

STREAMS: dict[str, int] = {}
"""Numbers of the streams by name, of the modules that are imported."""


def declare_stream(name: str, number: int) -> int:
    """Declare a random stream, once for a name and a number. Datasets depend on the number, so it never changes."""
    if STREAMS.get(name, number) != number or (name not in STREAMS and number in STREAMS.values()):
        raise ValueError(f"stream {name}, number {number}: one of them is taken; expected {STREAMS}, or new ones")
    STREAMS[name] = number
    return number


PARAMETERS, PATCH, SCATTER = declare_stream("parameters", 0), declare_stream("patch", 11), declare_stream("scatter", 12)
DARK_FRAME, MOTION = declare_stream("dark_frame", 14), declare_stream("motion", 17)

MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
ROUNDS = 10
LOW = 2**32 - 1
"""The low half of 64 bits."""
BLOCK, LANES = 64, 16
"""Pixels per block, and counters per block."""

Words = NDArray[np.uint32]


def stream_key(seed: int, source_sha256: str, occurrence: int = 0) -> int:
    """64-bit key of the random streams of an image, which adding or removing other files does not change.

    ``occurrence`` is the number of identical files before this one in the listing.
    """
    return _hash64(f"unprocess_gen stream 1\0{seed}\0{source_sha256}\0{occurrence}")


def split_uniform(seed: int, source_sha256: str) -> float:
    """Number in [0, 1) that decides the split of an image, from the SHA-256 of its file, or of its clip's first.

    Identical files have the same number, because copies of a photograph must not be in training and test data. Adding
    or removing files does not change it.
    """
    return float(_hash64(f"unprocess_gen split 1\0{seed}\0{source_sha256}") >> 11) * 2.0**-53


def body_key(seed: int, profile: str, unit: str) -> int:
    """64-bit key of the fixed patterns of a sensor unit of a noise profile, shared by all its frames."""
    return _hash64(f"unprocess_gen body 1\0{seed}\0{profile}\0{unit}")


def _hash64(name: str) -> int:
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")


def purpose(stream: int, level: int = 0, draw: int = 0) -> int:
    """Word 2 of the counter; ValueError unless level and draw are 0 to 4095."""
    if not (0 <= level < 4096 and 0 <= draw < 4096):
        raise ValueError(f"level={level}, draw={draw}: out of range; expected 0 to 4095")
    return stream << 24 | level << 12 | draw


EPOCHS, CLIP_FRAMES = 2**14, 2**18
"""Epochs, and frames of a clip that have epochs."""


def frame_word(frame: int, epoch: int = 0) -> int:
    """Word 3 of the counter, the frame itself in epoch 0; ValueError beyond `EPOCHS`, later beyond `CLIP_FRAMES`."""
    if not 0 <= epoch < EPOCHS or (epoch and frame >= CLIP_FRAMES):
        raise ValueError(
            f"epoch={epoch}, frame={frame}: out of range; expected epochs 0 to {EPOCHS - 1}, and after epoch 0 frames "
            f"0 to {CLIP_FRAMES - 1}"
        )
    return epoch << 18 | frame


def philox4x32(counter: tuple[NDArray[np.uint64], ...], key: int) -> tuple[Words, Words, Words, Words]:
    """Compute Philox4x32-10, as in Random123 (known answers: its ``kat_vectors``).

    The counter is four uint64 arrays of words below 2**32 that broadcast; the output words have the broadcast shape.
    """
    low, shift = np.uint64(LOW), np.uint64(32)
    m0, m1 = (np.uint64(multiplier) for multiplier in MULTIPLIERS)
    k0, k1 = key & LOW, key >> 32
    c0, c1, c2, c3 = counter
    for _ in range(ROUNDS):
        p0, p1 = m0 * c0, m1 * c2
        c0, c1 = (p1 >> shift) ^ c1 ^ np.uint64(k0), p1 & low
        c2, c3 = (p0 >> shift) ^ c3 ^ np.uint64(k1), p0 & low
        k0, k1 = (k0 + KEY_STEPS[0]) & LOW, (k1 + KEY_STEPS[1]) & LOW
    w0, w1, w2, w3 = (word.astype(np.uint32) for word in np.broadcast_arrays(c0, c1, c2, c3))
    return w0, w1, w2, w3


def words(
    key: int,
    stream: int,
    shape: tuple[int, int],
    *,
    origin: tuple[int, int] = (0, 0),
    frame: int = 0,
    level: int = 0,
    draw: int = 0,
) -> Words:
    """Draw one random word for each pixel of a tile, uint32 [H, W]; ``origin`` is its place in the full frame."""
    y = np.arange(origin[0], origin[0] + shape[0], dtype=np.uint64)[:, None]
    x = np.arange(origin[1], origin[1] + shape[1], dtype=np.uint64)[None, :]
    block, lane, lanes = np.uint64(BLOCK), x % np.uint64(LANES), np.uint64(LANES)
    counter = (x // block * lanes + lane, y, np.uint64(purpose(stream, level, draw)), np.uint64(frame))
    outputs = philox4x32(tuple(np.asarray(word) for word in counter), key)
    chosen = np.broadcast_to((x % block // lanes).astype(np.intp), shape)
    return np.asarray(np.choose(chosen, outputs), dtype=np.uint32)


def crop_words(key: int, patch: int, level: int, draw: int, word_3: int, crop: int = 0) -> tuple[int, int]:
    """Draw two 32-bit words for the place of a live crop in a patch; ``word_3`` is `frame_word`.

    They are a hash: one counter of Philox in Python takes 10 µs, a twentieth of a patch of 128 x 128.
    """
    number = _hash64(f"unprocess_gen crop 1\0{key}\0{patch}\0{level}\0{draw}\0{word_3}\0{crop}")
    return number >> 32, number & 0xFFFFFFFF


def even_corner(place: Sequence[int], side: int, height: int, width: int) -> tuple[int, int]:
    """Even row and column, chosen by two random words, of a square in a rectangle."""
    rows, columns = (height - side) // 2 + 1, (width - side) // 2 + 1
    return 2 * (place[0] * rows >> 32), 2 * (place[1] * columns >> 32)


def shuffled(length: int, seed: int, epoch: int) -> NDArray[np.int64]:
    """Draw a permutation of 0 to ``length`` - 1, the same on every machine: the order of 64-bit words."""
    counter = (0, np.arange(length, dtype=np.uint64), 0, epoch)
    key = _hash64(f"unprocess_gen order 1\0{seed}")
    high, low, _, _ = philox4x32(tuple(np.asarray(word, dtype=np.uint64) for word in counter), key)
    return np.argsort(high.astype(np.uint64) << np.uint64(32) | low, kind="stable")
