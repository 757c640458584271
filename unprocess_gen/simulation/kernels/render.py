"""Render clean and noisy frames strip by strip: the one compiled entry of all pairs.

Per strip: the clean frame (`clean`), then for each noisy frame a sampler and a read-out. Numba chooses the sampler by
the class of ``noise``, the precision by the class of ``inverse``, and the read-out by the class of ``readout``; so
compiled code contains only what a pair needs. Every form gives the same DN as `pair.reference_pair` on every processor,
except `clean.Unprocessing32` with `gaussian.Gaussian32`, which state their errors.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import PACKED, Frame, Srgb
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.kernels.clean import (
    Unprocessing32,
    fill_clean,
    is_steep,
    unprocessing_of,
    with_response,
)
from unprocess_gen.simulation.kernels.electron_records import electron_noise
from unprocess_gen.simulation.kernels.electrons import Electrons
from unprocess_gen.simulation.kernels.gaussian import Gaussian, Gaussian32, gaussian_noise
from unprocess_gen.simulation.kernels.jit import kernel
from unprocess_gen.simulation.kernels.philox import load_key, philox_keys
from unprocess_gen.simulation.kernels.readout import (
    Output,
    average_patterns,
    count_zero_variance,
    draw_noise,
    read_noisy,
    readout_of,
    write_clean,
)
from unprocess_gen.simulation.kernels.simd import pointer_to, pointers_of
from unprocess_gen.simulation.kernels.site_patterns import patterns_at
from unprocess_gen.simulation.kernels.strips import COUNT_FIELDS, STRIP, Scratch, buffers_in, locate, scratch_of_thread
from unprocess_gen.simulation.plan import FAST, Plan
from unprocess_gen.simulation.plan_slots import slots_of

Shape = tuple[int, int]
CODES = 256, 65536
"""Numbers of codes of images of 8 bits and of 16 bits."""


def render_clean(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Frame:
    """Simulate the clean frame only; parameters as for `pair.make_pair`."""
    renderer = renderer_of(srgb, (plan.replace(dark=None),), origin)
    return renderer.render(srgb, origin, renderer.keys[:0])[0]


class Renderer:
    """Render crops of ``shape`` from ``codes`` codes, whose first site is ``corner`` of the tile.

    What they share is prepared once, which takes longer than a crop of 128 x 128.
    """

    def __init__(self, plans: tuple[Plan, ...], shape: Shape, corner: Shape, codes: int) -> None:
        first, in_float32 = plans[0], uses_float32(plans[0])
        packed = first.output.layout == PACKED
        self._plans, self._shape = plans, shape
        self._frame_shape = (4, shape[0] // 2, shape[1] // 2) if packed else shape
        self._dtypes: Any = [
            np.float32 if is_normalised else np.uint16
            for is_normalised in (first.output.clean_normalised, first.output.normalised)
        ]
        self._inverse = unprocessing_of(first, codes, corner, in_float32)
        self._noise: Gaussian | Gaussian32 | None = None  # noise in electrons depends on the place
        if not first.counts_electrons:
            lines = tuple(plan.noise.variance_line for plan in plans)
            self._noise = gaussian_noise(lines, float(first.sensor.black_level_dn), in_float32)
        self._slots = () if self._noise else tuple(map(slots_of, plans))
        self._readout = readout_of(plans, shape if packed else (0, 0), corner, in_float32)
        self.keys = philox_keys(plans)

    def render(
        self,
        srgb: Srgb,
        origin: tuple[int, int],
        keys: NDArray[np.uint64],
        dark_pixels: DarkPixels | None = None,
        epoch: int = 0,
        frame: Shape | None = None,
    ) -> tuple[Frame, Frame, NDArray[np.int64]]:
        """Clean frame, a noisy frame for each key, and their numbers of `Counts`.

        Only the numbers of the first noisy frame include the counts of the clean frame. ``frame`` has the height and
        width from which live crops are cut.
        """
        inverse, frames = self._inverse, self._slots
        noise: Gaussian | Gaussian32 | Electrons | None = self._noise
        if noise is None:
            if epoch and any(slots.depends_on_epoch for slots in frames):
                frames = tuple(slots_of(plan.replace(epoch=epoch)) for plan in self._plans)
            patterns, factor = patterns_at(frames[0].patterns, self._shape, origin, frame, self._plans[0].averaged)
            if factor is not None:
                inverse = with_response(inverse, factor)
            reach = frame[1] if frame and frames is self._slots else 0  # the columns of all live crops are drawn once
            noise = electron_noise(self._plans, frames, patterns, dark_pixels, self._shape, origin, reach)
        clean = np.empty(self._frame_shape, self._dtypes[0])
        noisy = np.empty((len(keys), *self._frame_shape), self._dtypes[1])
        counts = np.zeros((max(len(keys), 1), COUNT_FIELDS), np.int64)
        # a view, a read-only array or a subclass would be another type, compiled again
        codes = srgb if type(srgb) is np.ndarray and srgb.flags.carray else np.array(srgb, order="C")
        scratch = scratch_of_thread(np.float32 if isinstance(inverse, Unprocessing32) else np.float64)
        sites = clean.reshape(-1), noisy.reshape(len(keys), clean.size)
        _render(codes, inverse, noise, keys, origin, self._readout, scratch, *sites, counts)
        return clean, noisy, counts


_renderers = [functools.lru_cache(maxsize=count)(Renderer) for count in (1024, 4)]
"""Renderers of images of 8 bits (18 kB each) and of 16 bits (5 MB each), wherever they are; kept for each size, because
records are hashed."""


def renderer_of(srgb: Srgb, plans: tuple[Plan, ...], origin: tuple[int, int]) -> Renderer:
    """Renderer of plans that share the clean frame, for images of this size; their noise has one kind and unit."""
    is_wide = srgb.itemsize > 1
    return _renderers[is_wide](plans, srgb.shape[:2], (origin[0] % 2, origin[1] % 2), CODES[is_wide])


def uses_float32(plan: Plan) -> bool:
    """True if a plan is rendered in float32, which its clean frame alone decides."""
    return plan.clean_accuracy == FAST and not is_steep(plan)


@kernel
def _render(
    srgb: Srgb,
    inverse: Any,
    noise: Any,
    keys: NDArray[np.uint64],
    origin: tuple[int, int],
    readout: Any,
    scratch: Scratch,
    clean: Frame,
    noisy: Frame,
    counts: NDArray[np.int64],
) -> None:
    """Fill the frames and counts of all pairs, strip by strip."""
    height, width = srgb.shape[:2]
    light, sampler, frames = pointers_of(inverse), pointers_of(noise), pointers_of(readout)
    buffers = buffers_in(scratch)
    codes, clean_sites, noisy_sites = pointer_to(srgb, 0), pointer_to(clean, 0), pointer_to(noisy, 0)
    key_words, all_counts, sites = pointer_to(keys, 0), pointer_to(counts, 0), clean.size
    for y in range(height):
        for x in range(0, width, STRIP):
            strip = locate(origin, y, x, min(STRIP, width - x))
            first = (y // 2) * (width // 2) + x // 2 if readout.packed else y * width + x
            source, target = pointer_to(codes, 3 * (y * width + x)), pointer_to(clean_sites, first)
            may_saturate = fill_clean(light, source, strip, buffers, all_counts)
            for n in range(noisy.shape[0]):
                output = Output(
                    pointer_to(noisy_sites, n * sites + first), pointer_to(all_counts, COUNT_FIELDS * n), may_saturate
                )
                draw_noise(sampler, n, load_key(key_words, n), strip, buffers)
                read_noisy(frames, sampler, n, output, strip, buffers)
                count_zero_variance(frames, n, output, strip, buffers)
            if readout.averaged:
                average_patterns(sampler, strip, buffers)
            write_clean(frames, Output(target, all_counts, may_saturate or readout.averaged), strip, buffers)
