"""Describe the noise that an effect adds to the sites of a plane, which ``verify --noise`` expects.

A site's noise is the sum of the noise of its effects, which are independent, and of known offsets. Signals are in DN
above black, frequencies τ in radians per DN.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.exact_distributions import LOGISTIC
from unprocess_gen.core.random_streams import words
from unprocess_gen.core.types import DarkPixels, Float, Patch, Plan
from unprocess_gen.simulation.reference.cfa import tile
from unprocess_gen.simulation.reference.noise import is_among

if TYPE_CHECKING:
    from unprocess_gen.simulation.effects import Physics

Complex = NDArray[np.inexact[Any]]
"""Values of a characteristic function; float64 if it is real."""

NORMAL_DISTANCE = 6.0
"""Distance that sites keep from the limits of the sensor, in standard deviations of the noise."""
ROWS_AT_ONCE = 256
"""Rows whose random words are in memory at once."""
RARE = 1e-5
"""Probability of a read-noise value beyond this distance."""


class Site(NamedTuple):
    """The sites of a pair at one ``place`` (row, column) of the 2x2 tile."""

    plan: Plan
    patch: Patch
    place: tuple[int, int]
    dark_pixels: DarkPixels | None = None

    @property
    def physics(self) -> Physics:
        """Numbers of the physical profile."""
        return self.plan.physics

    @property
    def shape(self) -> tuple[int, int]:
        """Even height and width of the patch."""
        return self.patch.height // 2 * 2, self.patch.width // 2 * 2

    def defects(self, stream: str, share: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns in the plane of a ``share`` of the body's pixels."""
        y, x = _rare_pixels(self.physics.body_key, stream, share, self.shape, self.patch.origin)
        own = (y % 2 == self.place[0]) & (x % 2 == self.place[1])
        return y[own] // 2, x[own] // 2

    @property
    def gain_dn(self) -> float:
        """DN of one electron; 0 if electrons are not counted."""
        plan, (y, x) = self.plan, self.place
        if plan.noise.physics is None:
            return plan.noise.a_dn if plan.noise.counts_electrons else 0.0
        relative = plan.noise.physics.gain_by_colour if "gain_by_colour" in plan.noise.effects else (1.0, 1.0, 1.0)
        return plan.noise.physics.dn_per_e * relative[tile(plan.sensor.pattern)[y][x]]


@functools.lru_cache(maxsize=8)
def _rare_pixels(
    body_key: int, stream: str, share: float, shape: tuple[int, int], origin: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the pixels that `is_among` selects; frames of a body have the same ones."""
    sites = []
    for top in range(0, shape[0], ROWS_AT_ONCE):
        strip, corner = (min(ROWS_AT_ONCE, shape[0] - top), shape[1]), (origin[0] + top, origin[1])
        sites.append(np.argwhere(is_among(words(body_key, stream, strip, origin=corner), share)) + np.array((top, 0)))
    y, x = np.concatenate(sites).T
    return y, x


class Defects(NamedTuple):
    """Sites of a plane with a known defect.

    Attributes
    ----------
    y, x : ndarray of int, [N]
        Rows and columns in the plane.
    level_dn : ndarray of float64, [N]
        Mean that is added to the signal, or that replaces it, DN above black.
    replaces : bool
        Whether it replaces the signal.
    """

    y: NDArray[np.intp]
    x: NDArray[np.intp]
    level_dn: Float
    replaces: bool


class EffectNoise(NamedTuple):
    """Noise that one effect adds to a site.

    Attributes
    ----------
    variance : callable
        Variance in DN² for an array of signals.
    factor : callable
        Factor of the characteristic function E[exp(iτ·noise)] for arrays of signals and frequencies.
    is_fixed : bool
        Whether the frames of one body share the values.
    tail_dn : float
        Distance beyond `NORMAL_DISTANCE` standard deviations that a fraction `RARE` of the values exceeds.
    tail : callable
        Fraction of values above a distance (DN).
    row_variance, row_correlation : float
        Variance of the common offset of a row (DN²), and its correlation with the offset of the next row.
    offset_dn : float or ndarray, broadcast to [H/2, W/2]
        Known offset of the noisy frame; NaN for sites that cannot be checked.
    clean_offset_dn : float
        Offset of the clean frame that is no light.
    largest_dn : float
        Signal at which the pixel is full.
    defects : Defects or None
        Sites with another value.
    """

    variance: Callable[[Float], Float] = np.zeros_like
    factor: Callable[[Float, Float], Complex] = lambda signal, tau: np.ones_like(signal)
    is_fixed: bool = False
    tail_dn: float = 0.0
    tail: Callable[[Float], Float] = np.zeros_like
    row_variance: float = 0.0
    row_correlation: float = 0.0
    offset_dn: float | Float | NDArray[np.float32] = 0.0
    clean_offset_dn: float = 0.0
    largest_dn: float = math.inf
    defects: Defects | None = None


def gaussian(variance: Callable[[Float], Float]) -> EffectNoise:
    """Normal noise."""
    return EffectNoise(variance, lambda signal, tau: np.exp(-0.5 * tau * tau * variance(signal)))


def constant(value: float) -> Callable[[Float], Float]:
    """Function of the signal that does not depend on it."""
    return lambda signal: np.full_like(signal, value)


def uniform(width_dn: float) -> EffectNoise:
    """Noise with a uniform distribution of this width."""
    variance = constant(width_dn * width_dn / 12)
    return EffectNoise(variance, lambda signal, tau: np.sinc(width_dn * tau / (2 * np.pi)))


def poisson_noise(gain_dn: float, rate_e: Callable[[Float], Float]) -> EffectNoise:
    """Poisson counts minus their mean, times a gain."""

    def factor(signal: Float, tau: Float) -> Complex:
        rate, phase = rate_e(signal), gain_dn * tau
        half_sine = np.sin(0.5 * phase)  # cos - 1 loses digits of small phases
        exponent = rate * (-2 * half_sine * half_sine + 1j * (np.sin(phase) - phase))
        return np.asarray(np.exp(exponent))

    return EffectNoise(lambda signal: gain_dn * gain_dn * rate_e(signal), factor)


def known_offset(site: Site, offset_dn: float | Float) -> EffectNoise:
    """Offset of the noisy frame, or of the clean one if that contains the fixed patterns."""
    if site.plan.noise.averaged:
        return EffectNoise(clean_offset_dn=float(np.mean(offset_dn)))
    return EffectNoise(offset_dn=offset_dn)


def tukey_noise(std_dn: float, shape: float) -> EffectNoise:
    """Read noise of Tukey's lambda distribution."""
    values, quantiles, logarithms = tukey_distribution(shape)
    largest = -float(np.interp(math.log(RARE), logarithms, quantiles))
    return EffectNoise(
        constant(std_dn * std_dn),
        lambda signal, tau: np.interp(np.abs(std_dn * tau), _FREQUENCIES, values),
        tail_dn=std_dn * max(largest - NORMAL_DISTANCE, 0.0),
        tail=lambda distance_dn: np.exp(np.interp(-distance_dn / std_dn, quantiles, logarithms, left=-math.inf)),
    )


LEAST_TAIL = 2.0**-33
"""Least tail probability of a random word."""
_FREQUENCIES = np.linspace(0.0, 8.0, 801)
"""Radians per standard deviation, for cos 2z at most 2, for codes more."""


@functools.lru_cache(maxsize=256)
def tukey_distribution(shape: float) -> tuple[Float, Float, Float]:
    """Characteristic function of Tukey's lambda distribution at `_FREQUENCIES`, quantiles, and log probabilities.

    They are for draws of standard deviation 1, as read noise is drawn. The trapezoidal rule in the logit of the
    probability p converges quickly: its error is below 3e-6 for shapes from -0.4.
    """
    logit, step = np.linspace(-40.0, 0.0, 1001, retstep=True)
    p = 1 / (1 + np.exp(-logit))
    weights = 2 * step * p * (1 - p)  # both halves: the distribution is symmetric
    weights[-1] /= 2
    tail = np.maximum(p, LEAST_TAIL)
    quantiles = np.log(tail / (1 - tail)) if abs(shape) < LOGISTIC else (tail**shape - (1 - tail) ** shape) / shape
    std = math.sqrt(float(quantiles**2 @ weights))
    return np.cos(np.outer(_FREQUENCIES, quantiles / std)) @ weights, quantiles / std, np.log(p)
