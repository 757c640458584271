"""Normal deviates in place of Poisson counts, as versions 0.1 and 0.2 drew them with ``accuracy=fast`` (NumPy).

New runs count everywhere: the method saved 2 % of a run. Rows and recorded settings of those versions name it as
`NEAR_NORMAL`, and get their bytes from this module. Deviates follow straight lines in float32, because frames of
those versions were computed so.
"""

from __future__ import annotations

import functools
import math
from decimal import localcontext

import numpy as np

from unprocess_gen.core.exact_distributions import DIGITS, tukey_core_std
from unprocess_gen.core.lookup_tables import FIRST_LINE, LINE_SHIFT, normal_table, quantile_lines
from unprocess_gen.core.random_streams import Words
from unprocess_gen.core.types import Float, Plan
from unprocess_gen.simulation.reference.poisson import poisson

MIN_READ_STD_E = 0.5
"""Least standard deviation of read noise with which a normal may replace counts.

Below it the steps of single electrons show, which no normal has: the Kolmogorov distance is 0.2/√rate without read
noise and 0.001/√rate at this value, in addition to the 0.07/√rate of `gaussian_distance` (skewness).
"""


def counts_or_normals(plan: Plan, words: Words, rate_e: Float) -> Float:
    """Draw the electrons of light: counts, or normal deviates where these are near enough.

    Parameters
    ----------
    plan : Plan
        Plan that names the method `types.NEAR_NORMAL`.
    words : ndarray of uint32
        Random words of the counts.
    rate_e : ndarray of float64
        Means of the same shape, electrons.

    Returns
    -------
    ndarray of float64
        Electrons, same shape.
    """
    lowest, highest = near_limits(plan)
    root = np.sqrt(rate_e.astype(np.float32))
    is_counted = (root > np.float32(math.sqrt(lowest))) & (root < np.float32(math.sqrt(highest)))
    rounded = np.rint(rate_e)
    residual = (rate_e - rounded).astype(np.float32)
    near = rounded.astype(np.float32) + (residual + root * _normals_by_lines(words))
    return np.where(is_counted, poisson(words, np.where(is_counted, rate_e, 0.0)), near.astype(np.float64))


def _normals_by_lines(words: Words) -> np.ndarray:
    """Return normal deviates by straight lines, float32, with errors below 1e-5."""
    f = (words & np.uint32(0x7FFFFFFF)).astype(np.float32) + np.float32(0.5)
    start, slope, _ = quantile_lines(normal_table())
    line = (f.view(np.uint32) >> np.uint32(LINE_SHIFT)) - np.uint32(FIRST_LINE)
    normal = start[line] + slope[line] * f
    return np.asarray(np.where(words >> np.uint32(31), -normal, normal))


def near_limits(plan: Plan) -> tuple[float, float]:
    """Return the mean electrons between which light is counted.

    Parameters
    ----------
    plan : Plan
        Plan that names the method `types.NEAR_NORMAL`.

    Returns
    -------
    (float, float)
        As `gaussian_from`; (0, infinity) if light is counted everywhere.
    """
    law_distance, physics = plan.accuracy.law_distance, plan.noise.physics
    if physics is None:
        a_dn, b_dn2 = plan.noise.variance_line
        read_std_e = math.sqrt(max(b_dn2, 0.0)) / a_dn
    else:
        read_std_e = physics.read_std_dn / physics.dn_per_e if "read" in plan.noise.effects else 0.0
        if physics.read_law == "tukey_lambda":
            read_std_e = read_std_e * core_share(physics.read_shape)
            law_distance = law_distance / CORE_MARGIN
    counts_all = plan.output.normalised or bool(plan.noise.dark.sha256) or "gain_by_colour" in plan.noise.effects
    if counts_all or read_std_e < MIN_READ_STD_E:
        return 0.0, math.inf
    return gaussian_from(read_std_e, law_distance)


def gaussian_distance(rate_e: float, read_std_e: float) -> float:
    """Return the CDF distance between shot plus read noise and a normal distribution of the same variance.

    The first Edgeworth term gives 0.0665 · rate / (rate + read_std²)^1.5: skewness / 6 times the maximum of
    |(z² - 1) φ(z)|, which is at 0. It ignores that electrons are integers; read noise below half an electron shows the
    steps, and `near_limits` always draws counts there.

    Parameters
    ----------
    rate_e : float
        Mean of the Poisson counts, electrons.
    read_std_e : float
        Standard deviation of the read noise, electrons.

    Returns
    -------
    float
        Largest difference of the two distribution functions; 0 without noise.
    """
    variance = rate_e + read_std_e * read_std_e
    return 0.0665 * (rate_e / variance) / math.sqrt(variance) if variance else 0.0


def gaussian_from(read_std_e: float, law_distance: float) -> tuple[float, float]:
    """Return the means for which a normal distribution is accurate enough for shot plus read noise.

    `gaussian_distance` increases up to a mean of twice the variance of the read noise, and decreases after it.

    Parameters
    ----------
    read_std_e : float
        Standard deviation of the read noise, electrons.
    law_distance : float
        Largest accepted `gaussian_distance`.

    Returns
    -------
    (float, float)
        (r0, r1): the distance is accepted for means up to r0 and from r1, in electrons. r0 = r1 if it is accepted
        everywhere; (0, infinity) for ``law_distance`` of 0.
    """
    if law_distance <= 0:
        return 0.0, math.inf
    peak = 2 * read_std_e * read_std_e
    if gaussian_distance(peak, read_std_e) <= law_distance and peak:
        return peak, peak
    far = max(peak, 1.0)
    while gaussian_distance(far, read_std_e) > law_distance:
        far *= 2
    below = _last_accepted(0.0, peak, read_std_e, law_distance) if peak else 0.0
    return below, _last_accepted(far, peak, read_std_e, law_distance)


CORE_MARGIN = 1.05
"""Factor by which law distances with read noise of the law ``tukey_lambda`` may exceed `gaussian_distance`.

It covers the steps of single electrons, of which a peaked density shows more."""

MAX_CORE_SHAPE = 0.3
"""Largest shape of Tukey's lambda distribution with which normals replace counts. The ends of the supports of larger
shapes show the skewness of the counts; no calibration has such shapes."""


@functools.lru_cache(maxsize=64)
def core_share(shape: float) -> float:
    """Return the relative std of normal read noise that smooths counts no more than Tukey's lambda distribution does.

    The first Edgeworth term is the curvature of the density of normal shot noise plus read noise. A mixture of normal
    densities has, by Jensen's inequality, at most that of the normal one with its curvature at 0
    (`exact_distributions.tukey_core_std`). Tests compare the bound with integrated distances for shapes from -0.45.

    Parameters
    ----------
    shape : float
        The distribution's λ, in (-½, 10).

    Returns
    -------
    float
        Factor of the standard deviation, at most 1, for `gaussian_from`; 0 for shapes above `MAX_CORE_SHAPE`.
    """
    if shape > MAX_CORE_SHAPE:
        return 0.0
    with localcontext(prec=DIGITS):
        return min(float(tukey_core_std(shape)), 1.0)


def _last_accepted(inside: float, outside: float, read_std_e: float, law_distance: float) -> float:
    """Return by bisection the accepted mean nearest to the boundary between ``inside`` and ``outside``."""
    for _ in range(60):
        middle = (inside + outside) / 2
        if gaussian_distance(middle, read_std_e) <= law_distance:
            inside = middle
        else:
            outside = middle
    return inside
