"""Divide rows into segments, and hold the buffers and frames that kernels fill.

Kernels process a row in segments short enough that their buffers stay in the L1 cache. Random words come in blocks of
64 pixels (`core.random_streams.BLOCK`), so buffers hold complete blocks; a segment begins ``first`` pixels into them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.core.types import Counts, Float, Pair, Raw, Srgb
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer, pointer_to

SEGMENT = 512
"""Most pixels processed at a time by the kernels with one normal per site: 35 kB of buffers, few used at once."""
LONG_SEGMENT = 1024
"""Most pixels processed at a time by the kernels of the physical effects."""

Float32 = NDArray[np.float32]
Indices = NDArray[np.uint32]

Frames = tuple[Raw, Raw, NDArray[np.int64]]
"""A clean frame ``[H, W]``, N noisy frames of it ``[N, H, W]``, and the numbers of `Counts` in their order ``[N, 6]``.

Kernels write the counts of the clean frame into the first row only.
"""
CLEAN_COUNTS = [0, 1, 4]
"""Columns of the counts that belong to the clean frame."""

_0 = np.uint64(0)
_MASK_BITS = np.arange(2**VECTOR_WIDTH)[:, None] >> np.arange(VECTOR_WIDTH) & 1
_LANES_BY_MASK = np.argsort(1 - _MASK_BITS, axis=1, kind="stable").astype(np.uint32).ravel()
_COUNT_BY_MASK = _MASK_BITS.sum(axis=1).astype(np.uint32)


def allocate_frames(srgb: Srgb, noisy: int = 1) -> Frames:
    """Allocate the frames and zeroed counts of ``noisy`` pairs of one photograph ``[H, W, 3]``."""
    height, width = srgb.shape[:2]
    frames = np.empty((height, width), dtype=np.uint16), np.empty((noisy, height, width), dtype=np.uint16)
    return *frames, np.zeros((noisy, 6), dtype=np.int64)


def frames_to_pairs(clean: Raw, noisy: Raw, counts: NDArray[np.int64]) -> list[Pair]:
    """Return one `Pair` per noisy frame of filled `Frames`; all share the clean array."""
    counts[1:, CLEAN_COUNTS] = counts[0, CLEAN_COUNTS]
    return [Pair(clean, frame, Counts(*numbers)) for frame, numbers in zip(noisy, counts.tolist(), strict=True)]


class SegmentBuffers(NamedTuple):
    """Hold the scratch arrays for one segment of a row, padded to complete blocks of 64 pixels.

    Python allocates them, since compiling the allocation takes half a second. Kernels pass them on as raw pointers.
    """

    signal: Float  # before white balance and highlights
    bright_light: Float  # normalised light of bright vectors, 0 elsewhere
    unrounded_dn: Float
    rounded_dn: Float32
    residual_dn: Float32  # unrounded_dn - rounded_dn
    words: Indices
    depths: Float32  # see `normal.fill_depths`
    noise_dn: Float32  # noise plus residual_dn: DN to add to rounded_dn
    error_dn: Float32  # bound of the error of noise_dn
    noisy_dn: Float32  # rounded, not clipped
    clean: Raw
    noisy: Raw
    uncertain: Indices  # sites to recompute exactly
    lanes_by_mask: Indices  # for each mask of eight lanes: its set lanes first
    count_by_mask: Indices  # for each mask: number of set lanes


def allocate_buffers(segment: int = SEGMENT) -> SegmentBuffers:
    """Allocate zeroed buffers for a segment: kernels also compute the padding, which must hold finite numbers."""
    size = segment + BLOCK
    doubles, singles = np.zeros((3, size)), np.zeros((6, size), dtype=np.float32)
    raw, words = np.zeros((2, size), dtype=np.uint16), np.zeros(size, dtype=np.uint32)
    uncertain = np.zeros(size + VECTOR_WIDTH, dtype=np.uint32)
    signal, bright_light, unrounded_dn = doubles
    rounded_dn, residual_dn, depths, noise_dn, error_dn, noisy_dn = singles
    return SegmentBuffers(
        signal, bright_light, unrounded_dn, rounded_dn, residual_dn, words, depths, noise_dn, error_dn, noisy_dn,
        raw[0], raw[1], uncertain, _LANES_BY_MASK, _COUNT_BY_MASK,
    )  # fmt: skip


@inner
def buffer_pointers(buffers: SegmentBuffers) -> SegmentBuffers:
    """Return the buffers as raw pointers."""
    return SegmentBuffers(
        pointer_to(buffers.signal, _0),
        pointer_to(buffers.bright_light, _0),
        pointer_to(buffers.unrounded_dn, _0),
        pointer_to(buffers.rounded_dn, _0),
        pointer_to(buffers.residual_dn, _0),
        pointer_to(buffers.words, _0),
        pointer_to(buffers.depths, _0),
        pointer_to(buffers.noise_dn, _0),
        pointer_to(buffers.error_dn, _0),
        pointer_to(buffers.noisy_dn, _0),
        pointer_to(buffers.clean, _0),
        pointer_to(buffers.noisy, _0),
        pointer_to(buffers.uncertain, _0),
        pointer_to(buffers.lanes_by_mask, _0),
        pointer_to(buffers.count_by_mask, _0),
    )


@inner
def locate_blocks(x: int, length: int) -> tuple[int, int, int, int]:
    """Locate a segment of ``length`` pixels from column ``x`` in its blocks of 64.

    Return its first and its end index within the blocks, the number of the first block, and how many blocks there are.
    """
    first = x % BLOCK
    after = first + length
    return first, after, x // BLOCK, (after + BLOCK - 1) // BLOCK


@inner
def copy_values(length: int, source: Pointer, target: Pointer) -> None:
    """Copy ``length`` values."""
    for x in range(length):
        target[x] = source[x]
