"""Measure how many pixels of a photograph are highlights between whose codes raw levels stay empty.

The inverse tone curve is steep at white, and preserved highlights are steeper still: two adjacent codes of 8 bits can
be far apart in raw. Nothing in the photograph shows where between them a site was, so the clean frame has no level
there.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import Plan, Srgb
from unprocess_gen.simulation.reference.unprocess import invert_gains

WIDE = 0.02
"""Least distance of two codes that counts, as a fraction of the raw range. Below the highlights none is as large."""


def coarse_share(srgb: Srgb, plan: Plan) -> float:
    """Fraction of the codes next to an empty range of raw levels, of gray pixels before the exposure.

    0 for raw sources, for 16-bit codes and for dithered highlights, whose widest range is up to 6 %.
    """
    if srgb.dtype != np.uint8 or plan.source.dequantize == "dither_all":
        return 0.0
    gray = np.repeat(linear_table(plan.isp.tone, plan.isp.gamma, 256)[:, None], 3, axis=1)
    light = invert_gains(gray, plan.camera.inverse_gains, plan.camera.highlight, plan.camera.highlight_threshold)
    wide = np.diff(np.minimum(light, 1), axis=0) >= WIDE
    edges = np.zeros((256, 3), dtype=bool)
    edges[:-1] |= wide
    edges[1:-1] |= wide[:-1]  # without white, which is clipped
    return float(np.mean([edge[srgb[..., channel]].mean() for channel, edge in enumerate(edges.T)]))
