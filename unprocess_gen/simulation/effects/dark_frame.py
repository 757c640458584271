"""Dark frames: the noise of the read-out is sampled from frames of the camera (SFRN, Zhang et al. 2021)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, Shape, SlotValues
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.plan import DarkFramePlan, Plan
from unprocess_gen.simulation.slots import SiteNoise

DITHER_DISTRIBUTION, DITHER_SHAPE = "tukey_lambda", 1.0
"""Uniform distribution, as Tukey's lambda distribution of shape 1."""


def dark_of(plan: Plan) -> DarkFramePlan:
    """Return the dark frame of a plan, which must have one."""
    assert plan.dark is not None
    return plan.dark


def dither_std_dn(plan: Plan) -> float:
    """Return the standard deviation of the dither of a dark frame, DN: uniform in ±½ DN of the dark frame."""
    return dark_of(plan).dark_scale / math.sqrt(12)


def dark_frame_offsets(
    plan: Plan,
    dark_pixels: DarkPixels | None,
    shape: Shape,
    origin: Shape = (0, 0),
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return the dark frame's contribution in ``out``, (frame - black level) · scale, [H, W] DN of the sensor.

    Frames smaller than the image are repeated: rows and columns count modulo the size of the frame, which is even.
    Raises ValueError if ``dark_pixels`` is None.
    """
    dark = dark_of(plan)
    if dark_pixels is None:
        raise ValueError(f"dark_pixels=None: the plan needs the dark frame {dark.dark_frame}; expected access to it")
    out = np.empty((shape[0], shape[1]), dtype=np.float32) if out is None else out
    frame = dark_pixels.frame(dark.dark_frame)
    black, scale = np.float32(dark.dark_black_dn), np.float32(dark.dark_scale)
    for y, from_y, rows in _runs(origin[0] + dark.shift[0], shape[0], frame.shape[0]):
        for x, from_x, columns in _runs(origin[1] + dark.shift[1], shape[1], frame.shape[1]):
            part, source = out[y : y + rows, x : x + columns], np.s_[from_y : from_y + rows, from_x : from_x + columns]
            np.subtract(frame[source], black, out=part, dtype=np.float32)
            if scale != 1:
                part *= scale
    return out


def _runs(start: int, count: int, period: int) -> Iterator[tuple[int, int, int]]:
    """Yield runs of a periodic sequence: first index in the result, first index in the period, and length."""
    done = 0
    while done < count:
        place = (start + done) % period
        length = min(period - place, count - done)
        yield done, place, length
        done += length


class DarkFrameNoise(Effect):
    """Dark frame in place of the read noise, with dither.

    A dark frame has integer values. Without dither, the sum of a constant signal and the frame is rounded at every site
    alike, so fractions of a DN are lost from the mean. SFRN samples within the bins too.
    """

    name = "dark_frame"
    stream = declare_stream("dark_dither", 15)
    meaning = "noise of the read-out, sampled from dark frames"
    has_switch = False

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the noise of a site with the dither, and the offsets by site."""
        dither = SiteNoise(self.stream, dither_std_dn(plan), DITHER_DISTRIBUTION, DITHER_SHAPE)
        return {"noise": dither, "has_site_offsets": True}
