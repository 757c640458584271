"""Divide rows into strips, and hold the scratch memory that the stages of a strip share.

Kernels process a row in strips short enough that their buffers stay in the L1 cache. Random words come in blocks of 64
pixels (`core.random_streams.BLOCK`); the other stages compute complete vectors. All strips of a frame begin at the same
place in a block and in a vector, because `STRIP` is a multiple of a block.
"""

from __future__ import annotations

import functools
import threading
from typing import Any, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float, Raw
from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.simulation.kernels import simd
from unprocess_gen.simulation.kernels.jit import inner
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer, Vector

STRIP = 512
"""Most pixels processed at a time."""
SIZE = STRIP + BLOCK
"""Length of the buffers."""

CACHE_LINE = 64
"""Bytes to whose multiples the buffers are aligned."""

Float32 = NDArray[np.float32]
Indices = NDArray[np.uint32]
CacheLines = NDArray[np.uint64]

_8 = np.uint64(8)
_MASK_BITS = np.arange(2**VECTOR_WIDTH)[:, None] >> np.arange(VECTOR_WIDTH) & 1
_LANES_BY_MASK = np.argsort(1 - _MASK_BITS, axis=1, kind="stable").ravel()
_COUNT_BY_MASK = _MASK_BITS.sum(axis=1)


def padded_width(left: int, width: int) -> int:
    """Return the number of columns of the complete blocks around ``width`` pixels from column ``left``."""
    return -(-(left % BLOCK + width) // BLOCK) * BLOCK


class Strip(NamedTuple):
    """Locate a strip in the crop, in the full frame, and in the buffers."""

    y: int  # row of the crop
    x: int  # first column in the crop
    length: int
    first: int  # index in the buffers of the first pixel, below VECTOR_WIDTH
    after: int  # index after the last pixel
    total: int  # buffer elements in use: complete vectors
    lead: int  # elements of the first block before the buffers
    blocks: int  # complete blocks that contain the strip
    block: np.uint64  # number of the first block in the row of the full frame
    row: np.uint64  # row of the full frame


@inner
def locate(origin: tuple[int, int], y: int, x: int, length: int) -> Strip:
    """Locate the strip of ``length`` pixels from (y, x) of a crop at ``origin`` of the full frame."""
    first = origin[1] % VECTOR_WIDTH
    lead = origin[1] % BLOCK - first
    total = (first + length + VECTOR_WIDTH - 1) // VECTOR_WIDTH * VECTOR_WIDTH
    blocks = (lead + total + BLOCK - 1) // BLOCK
    block, row = np.uint64((origin[1] + x) // BLOCK), np.uint64(origin[0] + y)
    return Strip(y, x, length, first, first + length, total, lead, blocks, block, row)


class SiteMap(NamedTuple):
    """A value for each pixel and for the columns that complete blocks add; else `SIZE` equal numbers.

    ``steps`` are the elements from row to row and from column to column, 0 if all are equal.
    """

    values: NDArray[Any]
    steps: tuple[int, int]


def equal_sites(value: float, dtype: Any = np.float32) -> SiteMap:
    """Return a map of equal values."""
    return SiteMap(np.full(SIZE, value, dtype=dtype), (0, 0))


@inner
def strip_values(site_map: SiteMap, strip: Strip) -> Pointer:
    """Return a pointer to the value of the strip's first site."""
    row, column = site_map.steps
    return simd.pointer_to(site_map.values, strip.y * row + strip.x * column + strip.lead)


class Buffers(NamedTuple):
    """Point to the scratch memory of one strip. The first four are float64, or float32 for the tier ``fast``."""

    signal: Any  # before white balance and highlights
    defects_e: Any  # additional electrons of bright defects; negative at dead pixels, 0 at others
    bright_light: Any  # normalised light in bright blocks, 0 elsewhere
    unrounded_dn: Any  # clean frame
    exact_dn: Float  # noisy frame before rounding
    row_dn: Float  # [1]: offset of the row
    rounded_dn: Float32  # clean frame, rounded
    residual_dn: Float32  # unrounded_dn - rounded_dn
    noise_dn: Float32  # approximate DN to add to the base of the read-out
    error_dn: Float32  # bound of the error of noise_dn
    noisy_dn: Float32  # rounded, not clipped
    normalised: Float32
    depths: Float32  # see `normal.fill_coarse_depths`
    normals: Float32  # of the counts of light
    highest: Float32  # of a block
    rates: Float32  # mean electrons
    light_e: Float32  # counts of light
    light_error_e: Float32  # bound of their error; 0 where the count is certain
    dark_e: Float32  # counts of one rate
    dark_error_e: Float32
    zeros: Float32
    words: Indices
    site_words: Indices
    dark_words: Indices
    defect_words: Indices
    scratch: Indices
    uncertain: Indices  # sites to recompute exactly
    lines: CacheLines  # scratch of look-ups
    clean: Raw
    noisy: Raw
    lanes_by_mask: Indices  # for each mask of eight lanes: its set lanes first
    count_by_mask: Indices  # for each mask: number of set lanes


_DTYPES = {Float: np.float64, Float32: np.float32, Indices: np.uint32, CacheLines: np.uint64, Raw: np.uint16}
_LENGTHS = {"lanes_by_mask": _LANES_BY_MASK.size}
"""Lengths of the buffers that are not `SIZE`."""


@functools.cache
def _places(dtype: np.dtype[Any]) -> dict[str, tuple[np.dtype[Any], int]]:
    """Return the dtype of each buffer and the byte of its index 0, for a clean frame of ``dtype``.

    A block lies before each buffer, because random words may begin at negative indices.
    """
    places, end = {}, 0
    for name, annotation in get_type_hints(Buffers).items():
        buffer_dtype = np.dtype(_DTYPES.get(annotation, dtype))
        places[name] = buffer_dtype, end + BLOCK * buffer_dtype.itemsize
        end += (BLOCK + _LENGTHS.get(name, SIZE)) * buffer_dtype.itemsize
    return places


Scratch = NDArray[Any]
"""Scratch memory of `Buffers`, one array of the dtype of the clean frame: Numba takes 0.2 µs to read each array.

Python allocates it, since compiling the allocation takes half a second.
"""


_threads = threading.local()


def scratch_of_thread(dtype: Any = np.float64) -> Scratch:
    """Return the scratch memory of this thread for frames in float64 or float32; allocating it takes 20 µs.

    Its signal is zero: a bright number in the padding would slow down its block, and in float32 change the rounding of
    the sites in its vector. So are its defects, which only frames with defects fill. No result depends on the rest.
    """
    known = vars(_threads)  # of this thread
    scratch: Scratch | None = known.get(dtype.__name__)
    if scratch is None:
        scratch = known[dtype.__name__] = allocate_scratch(dtype)
    scratch[: 2 * (BLOCK + SIZE)].fill(0)
    return scratch


def allocate_scratch(dtype: Any = np.float64) -> Scratch:
    """Allocate zeroed buffers: kernels also compute the padding of vectors, which must hold finite numbers."""
    last_dtype, last_start = _places(np.dtype(dtype))["count_by_mask"]
    size = last_start + (SIZE + BLOCK) * last_dtype.itemsize
    memory = np.zeros(size + CACHE_LINE, dtype=np.uint8)
    start = -memory.ctypes.data % CACHE_LINE
    scratch: Scratch = memory[start : start + size].view(dtype)
    buffers = buffers_in(scratch)
    buffers.lanes_by_mask[: _LANES_BY_MASK.size] = _LANES_BY_MASK
    buffers.count_by_mask[: _COUNT_BY_MASK.size] = _COUNT_BY_MASK
    return scratch


@simd.buffers_at("Buffers", _places)
def buffers_in(scratch: Scratch) -> Buffers:
    """Return pointers to the buffers of strips.

    Random words fill complete blocks, from index -`Strip.lead` on. All other stages begin at index 0, the first vector
    with pixels of the strip: in patches, a fifth of the elements of blocks lie outside.
    """
    memory = scratch.view(np.uint8)
    # a view ends with a further block, which negative indices reach in uncompiled kernels
    return Buffers(
        *(
            memory[start : start + (_LENGTHS.get(name, SIZE) + BLOCK) * dtype.itemsize].view(dtype)
            for name, (dtype, start) in _places(scratch.dtype).items()
        )
    )


@inner
def list_lanes(lanes: Vector, x: np.uint64, count: int, buffers: Buffers) -> int:
    """Append the indices of set lanes (`simd.less_than`) of the vector at ``x`` to ``uncertain``; return the length.

    Every call writes all eight lanes, and the next one overwrites the others: a branch would be mispredicted about
    every second time.
    """
    mask = simd.movemask(lanes)
    simd.store(buffers.uncertain, count, simd.load(buffers.lanes_by_mask, np.uint64(mask) * _8) + np.uint32(x))
    length: int = count + buffers.count_by_mask[mask]
    return length


CLEAN_LOW, CLEAN_HIGH, NOISY_LOW, NOISY_HIGH, SATURATED, ZERO_VARIANCE, LIGHT_HIGH = range(7)
"""Places of the members of `Counts` in the counts of a frame."""
COUNT_FIELDS = 7


@inner
def count_outside(strip: Strip, values: Pointer, low: float, high: float) -> tuple[int, int]:
    """Return the numbers of values of a strip below and above the limits."""
    below = above = 0
    for x in range(strip.first, strip.after):
        below += values[x] < low
        above += values[x] > high
    return below, above
