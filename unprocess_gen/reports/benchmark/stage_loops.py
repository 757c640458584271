"""Run single stages of the kernels over complete images or segments, for time measurements only.

Each loop calls the functions of `simulation.kernels` with buffers of the same size as a run does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import kernel
from unprocess_gen.core.random_streams import BLOCK, Words
from unprocess_gen.core.types import Float, Raw, Srgb
from unprocess_gen.simulation.kernels import gaussian_float32
from unprocess_gen.simulation.kernels.clean import (
    PairParameters,
    fill_clean,
    fill_signal,
    parameter_pointers,
    row_products,
    sum_products,
)
from unprocess_gen.simulation.kernels.normal import QuantileTables, fill_coarse_normals, fill_fine_normals
from unprocess_gen.simulation.kernels.poisson import CountBuffers, fill_counts
from unprocess_gen.simulation.kernels.readout import round_and_clip
from unprocess_gen.simulation.kernels.segments import LONG_SEGMENT, SEGMENT, Float32, SegmentBuffers, buffer_pointers
from unprocess_gen.simulation.kernels.simd import pointer_to
from unprocess_gen.simulation.reference.poisson import Tables as PoissonTables


@kernel
def loop_signals(srgb: Srgb, parameters: PairParameters, out: Float) -> None:
    """Look up the codes of an image in float64; the colour matrix is part of the tables."""
    height, width = srgb.shape[:2]
    pointers = parameter_pointers(parameters)
    for y in range(height):
        for start in range(0, width, LONG_SEGMENT):
            n, codes = min(LONG_SEGMENT, width - start), pointer_to(srgb, 3 * (y * width + start))
            fill_signal(codes, srgb.itemsize == 1, y, n, pointers, pointer_to(out, 0))


@kernel
def loop_signals32(srgb: Srgb, products: Float32, site_channels: NDArray[np.int64], out: Float32) -> None:
    """Look up the codes of an image in float32."""
    height, width = srgb.shape[:2]
    for y in range(height):
        even, odd = row_products(pointer_to(products, 0), products.shape[2], pointer_to(site_channels, 0), y)
        for start in range(0, width, LONG_SEGMENT):
            n, codes = min(LONG_SEGMENT, width - start), pointer_to(srgb, 3 * (y * width + start))
            sum_products(codes, even, odd, products.shape[2], n, srgb.itemsize == 1, pointer_to(out, 0))


@kernel
def loop_clean(srgb: Srgb, parameters: PairParameters, buffers: SegmentBuffers, counts: NDArray[np.int64]) -> None:
    """Compute the clean frame of an image in float64."""
    segment, pointers, count_pointer = buffer_pointers(buffers), parameter_pointers(parameters), pointer_to(counts, 0)
    height, width = srgb.shape[:2]
    for y in range(height):
        for start in range(0, width, SEGMENT):
            n, codes = min(SEGMENT, width - start), pointer_to(srgb, 3 * (y * width + start))
            fill_clean(codes, srgb.itemsize == 1, y, 0, n, pointers, segment, segment.clean, count_pointer)


@kernel
def loop_clean32(
    srgb: Srgb,
    products: Float32,
    sites: Float32,
    parameters: gaussian_float32.CleanParameters32,
    buffers: gaussian_float32.SegmentBuffers32,
) -> None:
    """Compute the clean frame of an image in float32."""
    height, width = srgb.shape[:2]
    segment = gaussian_float32.buffer_pointers32(buffers)
    channels = pointer_to(parameters.site_channels, 0)
    for y in range(height):
        even, odd = row_products(pointer_to(products, 0), products.shape[2], channels, y)
        row_sites = gaussian_float32.load_site_parameters(sites, y & 1, 0)
        for start in range(0, width, SEGMENT):
            n = min(SEGMENT, width - start)
            codes = pointer_to(srgb, 3 * (y * width + start))
            sum_products(codes, even, odd, products.shape[2], n, srgb.itemsize == 1, segment.signal)
            blocks = -(-n // BLOCK)
            some_bright = gaussian_float32.fill_linear32(blocks, row_sites[0], parameters, segment, segment.clean)[1]
            if some_bright:
                gaussian_float32.recompute_bright32(blocks, row_sites, parameters, segment, segment.clean)


@kernel
def loop_readout(
    segments: Float, repeats: int, limits_dn: tuple[float, float], noisy: Raw, counts: NDArray[np.int64]
) -> None:
    """Round and clip segments of DN in float64, repeatedly."""
    for _ in range(repeats):
        for index in range(segments.shape[0]):
            round_and_clip(segments[index], limits_dn, noisy, counts)


@kernel
def loop_readout32(
    segments: Float32, repeats: int, parameters: gaussian_float32.NoiseParameters32, black: np.uint32, noisy: Raw
) -> None:
    """Round and clip segments of DN in float32, repeatedly."""
    length = segments.shape[1]
    for _ in range(repeats):
        for index in range(segments.shape[0]):
            values, out = pointer_to(segments, index * length), pointer_to(noisy, 0)
            gaussian_float32.round_and_clip32(length, parameters, black, values, out)


@kernel
def loop_normals(segments: Words, repeats: int, depths: Float32, out: Float32) -> None:
    """Compute the normal deviates that the float64 kernels use first, repeatedly."""
    for _ in range(repeats):
        for index in range(segments.shape[0]):
            fill_fine_normals(segments[index], depths, out)


@kernel
def loop_normals32(segments: Words, repeats: int, depths: Float32, out: Float32) -> None:
    """Compute the normal deviates of the float32 kernels, repeatedly."""
    for _ in range(repeats):
        for index in range(segments.shape[0]):
            fill_coarse_normals(segments[index], depths, out)


@kernel
def loop_counts(
    rates: Float,
    repeats: int,
    words: Words,
    normal: QuantileTables,
    tables: PoissonTables,
    buffers: CountBuffers,
    out: Float,
) -> None:
    """Draw Poisson counts for segments of rates, repeatedly."""
    for _ in range(repeats):
        for index in range(rates.shape[0]):
            fill_counts(words[index], rates[index], normal, tables, buffers, out)
