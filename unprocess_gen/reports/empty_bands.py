"""Find the bands of raw levels that no code of an 8-bit photograph reaches.

The inverse tone curve is steep at white, and preserved highlights are steeper still: two adjacent codes can be far
apart in raw. Nothing in the photograph shows where in such a band a site was, so the clean frame has no level there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import Float, Plan, Srgb
from unprocess_gen.reports.formatting import percentage
from unprocess_gen.simulation.reference.unprocess import invert_gains

WIDE = 0.02
"""Least width of a band that counts, as a fraction of the raw range. Below the highlights no band is as wide."""

RGB = ("R", "G", "B")
SITE_SHARES = (0.25, 0.5, 0.25)
"""Fraction of the sites of each channel in a Bayer pattern."""


class EmptyBands(NamedTuple):
    """The fraction of the sites whose code is next to an empty band, and the widest band of R, G and B.

    White sites are not counted. Widths are fractions of the raw range, for gray pixels.
    """

    share: float
    widest: tuple[float, float, float]


NO_BANDS = EmptyBands(0.0, (0.0, 0.0, 0.0))


def empty_bands(srgb: Srgb, plan: Plan) -> EmptyBands:
    """Find the empty bands of a photograph and count the sites next to them.

    `NO_BANDS` for 16-bit codes and for dithered highlights. Their widest band is next to white: up to 6 % of the range.
    """
    if srgb.dtype != np.uint8 or plan.source.dequantize == "dither_all":
        return NO_BANDS
    widths = band_widths(plan)
    wide = widths >= WIDE
    edges = np.zeros((256, 3), dtype=bool)
    edges[:255] |= wide
    edges[1:255] |= wide[:-1]
    shares = [edge[srgb[..., channel]].mean() for channel, edge in enumerate(edges.T)]
    red, green, blue = np.where(wide, widths, 0).max(axis=0).tolist()
    return EmptyBands(float(np.dot(SITE_SHARES, shares)), (red, green, blue))


def highlight_sentence(bands: Sequence[EmptyBands]) -> str:
    """Return the mean share of the sites, the widest bands and the remedy; empty if no site is next to a band."""
    share = float(np.mean([band.share for band in bands])) if bands else 0.0
    if not share:
        return ""
    widest = np.max([band.widest for band in bands], axis=0)
    widths = ", ".join(f"{100 * width:.0f} % ({name})" for name, width in zip(RGB, widest, strict=True) if width)
    return (
        f"{percentage(share)} of the sites are highlights where 8-bit codes are coarse: neighbouring codes are up to "
        f"{widths} of the raw range apart; source.dequantize=dither_all fills the bands"
    )


def band_widths(plan: Plan) -> Float:
    """Return the distance in raw between each code and the next, [255, 3], for gray pixels before the exposure."""
    gray = np.repeat(linear_table(plan.isp.tone, plan.isp.gamma, 256)[:, None], 3, axis=1)
    light = invert_gains(gray, plan.camera.inverse_gains, plan.camera.highlight, plan.camera.highlight_threshold)
    return np.diff(np.minimum(light, 1), axis=0)
