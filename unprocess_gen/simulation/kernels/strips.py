"""Divide rows into strips, and hold the scratch memory that the stages of a strip share.

Kernels process a row in strips short enough that their buffers stay in the L1 cache. Random words come in blocks of 64
pixels (`core.random_streams.BLOCK`), so buffers hold complete blocks; a strip begins ``first`` pixels into them. All
strips of a frame have the same ``first``, because `STRIP` is a multiple of a block.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.core.types import Float, Raw
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    Pointer,
    Vector,
    load,
    movemask,
    store,
)

STRIP = 512
"""Most pixels processed at a time."""
SIZE = STRIP + BLOCK
"""Length of the buffers."""

Float32 = NDArray[np.float32]
Indices = NDArray[np.uint32]

_8 = np.uint64(8)
_MASK_BITS = np.arange(2**VECTOR_WIDTH)[:, None] >> np.arange(VECTOR_WIDTH) & 1
_LANES_BY_MASK = np.argsort(1 - _MASK_BITS, axis=1, kind="stable").astype(np.uint32).ravel()
_COUNT_BY_MASK = _MASK_BITS.sum(axis=1).astype(np.uint32)


def padded_width(left: int, width: int) -> int:
    """Return how many columns the complete blocks around ``width`` pixels from column ``left`` have."""
    return -(-(left % BLOCK + width) // BLOCK) * BLOCK


class Strip(NamedTuple):
    """Locate a strip in the crop, in the full frame, and in the buffers."""

    y: int  # row of the crop
    x: int  # first column in the crop
    length: int
    first: int  # index in the buffers of the first pixel
    after: int  # index after the last pixel
    total: int  # buffer elements in use: complete blocks
    block: np.uint64  # number of the first block in the row of the full frame
    row: np.uint64  # row of the full frame


@inner
def locate(origin: tuple[int, int], y: int, x: int, length: int) -> Strip:
    """Locate the strip of ``length`` pixels from (y, x) of a crop at ``origin`` of the full frame."""
    first = (origin[1] + x) % BLOCK
    count = (first + length + BLOCK - 1) // BLOCK * BLOCK
    block, row = np.uint64((origin[1] + x) // BLOCK), np.uint64(origin[0] + y)
    return Strip(y, x, length, first, first + length, count, block, row)


class Workspace(NamedTuple):
    """Hold the scratch arrays of one strip. The first three are float64, or float32 for the tier ``fast``.

    Python allocates them, since compiling the allocation takes half a second.
    """

    signal: Any  # before white balance and highlights
    bright_light: Any  # normalised light in bright blocks, 0 elsewhere
    unrounded_dn: Any  # clean frame
    exact_dn: Float  # noisy frame before rounding
    rounded_dn: Float32  # clean frame, rounded
    residual_dn: Float32  # unrounded_dn - rounded_dn
    noise_dn: Float32  # approximate DN to add to the base of the read-out
    error_dn: Float32  # bound of the error of noise_dn
    noisy_dn: Float32  # rounded, not clipped
    clean: Raw
    noisy: Raw
    normalised: Float32
    words: Indices
    read_words: Indices
    dark_words: Indices
    depths: Float32  # see `normal.fill_depths`
    normals: Float32
    lines: NDArray[np.uint64]  # scratch of look-ups
    more_lines: NDArray[np.uint64]
    scratch: Indices
    errors: Float32
    rates: Float  # mean electrons, and what the counts need of them: see `poisson.Rates`
    rounded_e: Float32
    residual_e: Float32
    root: Float32
    inverse: Float32
    electrons: Float32  # shot noise
    dark_rates: Float
    dark: Float32  # counts of the dark signal
    total_e: Float32
    defects: Float  # electrons of hot pixels; negative at dead pixels, 0 at others
    zeros: Float32
    row_dn: Float  # [1]: offset of the row
    uncertain: Indices  # sites to recompute exactly
    lanes_by_mask: Indices  # for each mask of eight lanes: its set lanes first
    count_by_mask: Indices  # for each mask: number of set lanes


_threads = threading.local()


def workspace_of_thread() -> Workspace:
    """Return the scratch memory of this thread for frames in float64; allocating it takes 30 µs.

    No result depends on its content. In float32 some do: a bright number in the padding changes the rounding of the
    sites in its vector. So frames in float32 always begin with zeros, from `allocate_workspace`.
    """
    if not hasattr(_threads, "workspace"):
        _threads.workspace = allocate_workspace()
    workspace: Workspace = _threads.workspace
    workspace.signal.fill(0)  # a bright number left in the padding would slow down its block
    return workspace


def allocate_workspace(dtype: Any = np.float64) -> Workspace:
    """Allocate zeroed buffers: kernels also compute the padding of blocks, which must hold finite numbers."""
    signal, bright_light, unrounded_dn = np.zeros((3, SIZE), dtype=dtype)
    exact_dn, rates, dark_rates, defects = np.zeros((4, SIZE))
    singles = np.zeros((17, SIZE), dtype=np.float32)
    rounded_dn, residual_dn, noise_dn, error_dn, noisy_dn, normalised, depths, normals = singles[:8]
    rounded_e, residual_e, root, inverse, electrons, dark, total_e, zeros, errors = singles[8:]
    clean, noisy = np.zeros((2, SIZE), dtype=np.uint16)
    row_dn = np.zeros(1)
    words, read_words, dark_words, scratch = np.zeros((4, SIZE), dtype=np.uint32)
    lines, more_lines = np.zeros((2, SIZE), dtype=np.uint64)
    uncertain = np.zeros(2 * SIZE + VECTOR_WIDTH, dtype=np.uint32)
    return Workspace(
        signal, bright_light, unrounded_dn, exact_dn, rounded_dn, residual_dn, noise_dn, error_dn, noisy_dn, clean,
        noisy, normalised, words, read_words, dark_words, depths, normals, lines, more_lines, scratch, errors, rates,
        rounded_e, residual_e, root, inverse, electrons, dark_rates, dark, total_e, defects, zeros, row_dn, uncertain,
        _LANES_BY_MASK, _COUNT_BY_MASK,
    )  # fmt: skip


@inner
def list_lanes(lanes: Vector, x: np.uint64, found: int, workspace: Workspace) -> int:
    """Append the indices of set lanes (`simd.less_than`) of the vector at ``x`` to ``uncertain``; return the length.

    Every call writes all eight lanes, and the next one overwrites the others: a branch would be mispredicted about
    every second time.
    """
    mask = movemask(lanes)
    store(workspace.uncertain, found, load(workspace.lanes_by_mask, np.uint64(mask) * _8) + np.uint32(x))
    return found + int(workspace.count_by_mask[mask])


@inner
def copy_values(length: int, source: Pointer, target: Pointer) -> None:
    """Copy ``length`` values."""
    for x in range(length):
        target[x] = source[x]
