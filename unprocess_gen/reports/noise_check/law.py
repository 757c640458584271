"""Compute the distribution of the noise that a manifest row records, effect by effect.

A site's noise is a sum of independent effects. Each effect in `EFFECTS` contributes a variance and a factor of the
characteristic function E[exp(iτ·noise)], both as functions of the signal. Products of these factors give the exact
expectation of cos(τ·noise), which `scores` compares with the arrays. Cosines are bounded, so their means are
normally distributed even for read noise with heavy tails, of which sample variances are not.

To support another effect, add one function to `EFFECTS`. Pairs with an effect that has no entry cannot be checked.

Notes
-----
Means of fixed patterns that the row determines (columns, black-level errors) are in `NoiseLaw.offset_dn`. PRNU is
random here, and marked as fixed: frames of one body share it, so it does not average out over pairs.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.exact_distributions import LOGISTIC, tukey_std
from unprocess_gen.core.types import DarkPixels, Float, Patch, Physics, Plan
from unprocess_gen.simulation.reference import noise as reference
from unprocess_gen.simulation.reference.sensor import noisy_limits

Complex = NDArray[np.inexact[Any]]
"""Values of a characteristic function; float64 if it is real."""

RARE = 1e-5
"""Probability of a read-noise value beyond the distance that sites keep from the limits of the sensor."""
NORMAL_DISTANCE = 6.0
"""The same distance for shot noise and Gaussian read noise, in standard deviations."""


APPROXIMATE_SHOT = "shot:gaussian_where_near"
"""Method that replaces counts of electrons by normal deviates at some rates."""


class Term(NamedTuple):
    """Hold what one effect adds to the noise of a site.

    Attributes
    ----------
    variance : callable
        Variance in DN² for a signal in DN above black (array).
    factor : callable
        Factor of the characteristic function for signal and frequency τ (arrays; radians per DN).
    is_fixed : bool
        Whether the frames of one body share the values.
    """

    variance: Callable[[Float], Float]
    factor: Callable[[Float, Float], Complex]
    is_fixed: bool = False


class Factors(NamedTuple):
    """Characteristic function E[exp(iτ·noise)] at some signals and frequencies.

    Attributes
    ----------
    signal, tau : ndarray of float64
        Signals in DN above black, and frequencies in radians per DN.
    temporal, fixed : ndarray of complex128 or float64
        Factor of the noise that is new in every frame, and of the patterns that frames of one body share.
    value : ndarray of complex128 or float64
        Characteristic function of all noise, with outliers.
    """

    signal: Float
    tau: Float
    temporal: Complex
    fixed: Complex
    value: Complex


class Outliers(NamedTuple):
    """Rare sites with another value: their fraction, and the mean excess in DN (hot) or their value (dead)."""

    share: float
    value_dn: float


def _gaussian(variance: Callable[[Float], Float], is_fixed: bool = False) -> Term:
    return Term(variance, lambda u, tau: np.exp(-0.5 * tau * tau * variance(u)), is_fixed)


def _product(terms: Sequence[Term], signal: Float, tau: Float) -> Complex:
    """Return the product of the factors of some terms."""
    factors = (term.factor(signal, tau) for term in terms)
    return functools.reduce(operator.mul, factors, np.ones(signal.shape))


def _constant(variance_dn2: float) -> Callable[[Float], Float]:
    return lambda u: np.full_like(u, variance_dn2)


def _counts(gain_dn: float, rate_e: Callable[[Float], Float], normal: tuple[float, float] = (0.0, math.inf)) -> Term:
    """Return Poisson counts minus their mean, times a gain; ``normal``: rates up to and from which they are normal."""

    def factor(u: Float, tau: Float) -> Complex:
        rate, phase = rate_e(u), gain_dn * tau
        half_sine = np.sin(0.5 * phase)  # cos - 1 loses digits of small phases
        counted: Complex = np.exp(rate * (-2 * half_sine * half_sine + 1j * (np.sin(phase) - phase)))
        if normal == (0.0, math.inf):
            return counted
        is_normal = (rate <= normal[0]) | (rate >= normal[1])
        return np.asarray(np.where(is_normal, np.exp(-0.5 * rate * phase * phase), counted))

    return Term(lambda u: gain_dn * gain_dn * rate_e(u), factor)


# ------------------------------------------------------------------------------------------------------------- effects


def _heteroscedastic(plan: Plan) -> list[Term]:
    a, b = plan.variance_line
    if plan.noise_law == "gaussian" or a == 0:
        return [_gaussian(lambda u: np.maximum(a * u + b, 0.0))]
    return [_shot_of(plan, a, math.sqrt(max(b, 0.0))), _gaussian(_constant(max(b, 0.0)))]


def _shot(plan: Plan) -> list[Term]:
    physics = _physics(plan)
    return [_shot_of(plan, physics.dn_per_e, physics.read_std_dn if "read" in plan.effects else 0.0)]


def _shot_of(plan: Plan, gain_dn: float, read_std_dn: float) -> Term:
    normal = (0.0, math.inf)
    if APPROXIMATE_SHOT in plan.methods:
        from unprocess_gen.simulation.kernels.electron_records import count_roots  # imports Numba

        lowest, highest = count_roots(plan, read_std_dn / gain_dn, plan.normalised)
        normal = lowest * lowest, highest * highest
    return _counts(gain_dn, lambda u: np.maximum(u, 0.0) / gain_dn, normal)


def _prnu(plan: Plan) -> list[Term]:
    physics = _physics(plan)
    if physics.fixed_pattern_in_clean:
        return []
    return [_gaussian(lambda u: (physics.prnu_std * u) ** 2, is_fixed=True)]


def _dark_current(plan: Plan) -> list[Term]:
    physics = _physics(plan)
    return [_counts(physics.dn_per_e, lambda u: np.full_like(u, physics.dark_e))]


def _read(plan: Plan) -> list[Term]:
    physics = _physics(plan)
    std, shape = physics.read_std_dn, physics.read_shape
    if physics.read_law == "gaussian":
        return [_gaussian(_constant(std * std))]
    law = physics.read_law
    return [Term(_constant(std * std), lambda u, tau: tukey_factor(std * tau, law, shape))]


def _dark_frame(plan: Plan) -> list[Term]:
    """Dither of a dark frame; its pixels are an offset that `NoiseLaw.offsets` returns."""
    width_dn = plan.dark_scale
    return [Term(_constant(width_dn * width_dn / 12), lambda u, tau: np.sinc(width_dn * tau / (2 * np.pi)))]


def _row(plan: Plan) -> list[Term]:
    return [_gaussian(_constant(_physics(plan).row_std_dn ** 2))]


def _quantise(plan: Plan) -> list[Term]:
    return [] if plan.normalised else [Term(_constant(1 / 12), lambda u, tau: np.sinc(tau / (2 * np.pi)))]


def _none(plan: Plan) -> list[Term]:
    """Effects that only move values by a known offset, move few sites, or act near the limits of the sensor."""
    return []


EFFECTS: dict[str, Callable[[Plan], list[Term]]] = {
    "heteroscedastic": _heteroscedastic,
    "lens_shading": _none,  # the clean frame has it too
    "prnu": _prnu,
    "shot": _shot,
    "dark_current": _dark_current,
    "hot_pixels": _none,  # `NoiseLaw.hot`
    "full_well": _none,  # `NoiseLaw.is_far_from_limits`
    "gain_by_colour": _none,  # `NoiseLaw.of_site`
    "read": _read,
    "dark_frame": _dark_frame,
    "row": _row,  # also `NoiseLaw.rows`
    "column": _none,  # `NoiseLaw.offset_dn`
    "column_temporal": _none,  # `NoiseLaw.offset_dn`, because the row determines it
    "black_error": _none,  # `NoiseLaw.offset_dn`
    "dead_pixels": _none,  # `NoiseLaw.dead`
    "quantise": _quantise,
}
"""What each effect adds to the noise of a site. A new effect enters the checks here."""


def is_supported(plan: Plan, dark_pixels: DarkPixels | None) -> bool:
    """Return whether the noise of a plan can be checked.

    Parameters
    ----------
    plan : Plan
        Plan of a pair.
    dark_pixels : DarkPixels or None
        Access to the dark frames of the dataset.

    Returns
    -------
    bool
        False if an effect has no entry in `EFFECTS`, and for plans with a dark frame without access to it.
    """
    return EFFECTS.keys() >= set(plan.effects) and not (plan.dark_frame and dark_pixels is None)


def _plans_by_site(plan: Plan) -> list[Plan]:
    """Return plans with the gain of each site of the tile in place of gains by colour; empty without them."""
    if "gain_by_colour" not in plan.effects:
        return []
    physics = _physics(plan)
    gains = [physics.gain_by_colour["RGB".index(colour)] for colour in plan.pattern]
    return [
        replace(
            plan,
            a_dn=plan.a_dn * gain,
            physics=replace(physics, dn_per_e=physics.dn_per_e * gain, full_well_e=physics.full_well_e / gain),
            effects=tuple(effect for effect in plan.effects if effect != "gain_by_colour"),
            methods=tuple(method for method in plan.methods if method != APPROXIMATE_SHOT),  # as kernels do
        )
        for gain in gains
    ]


def _physics(plan: Plan) -> Physics:
    assert plan.physics is not None
    return plan.physics


# ----------------------------------------------------------------------------------------------------------------- law


class LineOffsets(NamedTuple):
    """Offsets of rows or columns, or their differences, with their correlations.

    Attributes
    ----------
    variance : float
        Variance of an offset, DN².
    magnitudes, squares : float
        Sums over all lines of the magnitudes and of the squares of their correlations with one line. The former bounds
        the eigenvalues of the correlation matrix.
    """

    variance: float
    magnitudes: float = 1.0
    squares: float = 1.0


def row_offsets(variance: float, correlation: float) -> LineOffsets:
    """Return the offsets of rows, an autoregressive process of order 1."""
    size, square = abs(correlation), correlation * correlation
    return LineOffsets(variance, (1 + size) / (1 - size), (1 + square) / (1 - square))


def row_differences(variance: float, correlation: float) -> LineOffsets:
    """Return the differences of rows n and n + 2 of such a process, for the first two rows of groups of four.

    At a distance of k rows, the covariance is variance · (2 rᵏ - rᵏ⁺² - r^|k-2|); the sums are geometric series.
    """
    size, square = abs(correlation), correlation * correlation
    return LineOffsets(
        2 * variance * (1 - square),
        1 + size / 2 + size * (1 + size) ** 2 / (2 * (1 + square)),
        1 + square / (2 * (1 + square * square)),
    )


class NoiseLaw:
    """The noise that a plan predicts for each site of a pair.

    With gains by colour, it is that of a site with the gain 1, and `of_site` returns that of the others.

    Parameters
    ----------
    plan : Plan
        Plan of the pair, from its manifest row.
    patch : Patch
        Part of the full frame that the pair shows.
    dark_pixels : DarkPixels or None
        Access to the dark frame of the plan, if it has one.

    Raises
    ------
    KeyError
        If an effect of the plan has no entry in `EFFECTS`.
    """

    def __init__(self, plan: Plan, patch: Patch, dark_pixels: DarkPixels | None = None) -> None:
        self.plan = plan
        self._patch, self._dark_pixels = patch, dark_pixels
        terms = [term for effect in plan.effects for term in EFFECTS[effect](plan)]
        self._temporal = [term for term in terms if not term.is_fixed]
        self._fixed = [term for term in terms if term.is_fixed]
        self.limits = noisy_limits(plan.bits, plan.black_level_dn, plan.sensor_clip)
        rows = self._number("row", "row_std_dn") ** 2, self._number("row", "row_correlation")
        self.rows, self.row_differences = row_offsets(*rows), row_differences(*rows)
        self.hot, self.dead = self._hot(), self._dead()
        self.offset_dn, self._clean_offset_dn = self._offsets(patch)
        self._by_site = [NoiseLaw(one, patch) for one in _plans_by_site(plan)]
        for (y, x), law in zip(itertools.product((0, 1), repeat=2), self._by_site, strict=False):
            self.offset_dn[y, x::2] = law.offset_dn[y, x::2]

    @property
    def differs_by_site(self) -> bool:
        """Return whether the expectations for a clean DN differ between the sites of the tile."""
        return self.plan.averaged or bool(self._by_site)

    def of_site(self, number: int) -> NoiseLaw:
        """Return the law of a site of the 2x2 tile, counted row by row."""
        return self._by_site[number] if self._by_site else self

    @property
    def line(self) -> tuple[float, float]:
        """Slope (DN) and intercept (DN²) of the noise variance against the signal, without rounding and PRNU."""
        if "heteroscedastic" in self.plan.effects:
            return self.plan.a_dn, self.plan.b_dn2
        at_black = float(self.variance(np.zeros(1))[0]) - self.rounding_dn2
        return self.plan.variance_line[0], at_black

    @property
    def rounding_dn2(self) -> float:
        """Variance that the rounding of the noisy frame adds, DN²."""
        return 1 / 12 if "quantise" in self.plan.effects else 0.0

    @property
    def gain_dn(self) -> float:
        """DN of one electron; 0 if electrons are not counted."""
        if self.plan.physics is not None:
            return self.plan.physics.dn_per_e
        return self.plan.a_dn if self.plan.counts_electrons else 0.0

    def _number(self, effect: str, name: str) -> float:
        return float(getattr(self.plan.physics, name)) if effect in self.plan.effects else 0.0

    def _hot(self) -> Outliers:
        gain = 0.0 if self.plan.physics is None else self.plan.physics.dn_per_e
        share = 0.0 if self.plan.averaged else self._number("hot_pixels", "hot_pixel_share")
        return Outliers(share, gain * self._number("hot_pixels", "hot_pixel_e"))

    def _dead(self) -> Outliers:
        share = 0.0 if self.plan.averaged else self._number("dead_pixels", "dead_pixel_share")
        return Outliers(share, max(self.limits[0], 0.0))

    def _offsets(self, patch: Patch) -> tuple[Float, Float]:
        """Return what is known to be added to the noisy frame [2, W], and to black in the clean one [2, 2]."""
        plan, physics = self.plan, self.plan.physics
        if physics is None:
            return np.zeros((2, patch.width)), np.zeros((2, 2))
        dark = self._number("dark_current", "dark_e") * physics.dn_per_e if physics.dark_offset == "kept" else 0.0
        temporal: Float = np.zeros(patch.width)
        if "column_temporal" in plan.effects:
            temporal = reference.column_temporal(plan, patch.width, patch.origin[1])
        if not plan.averaged:
            fixed = reference.offsets(plan, (2, patch.width), patch.origin, fixed_only=True)
            return fixed + temporal + dark, np.zeros((2, 2))
        errors = reference.black_error(physics, (2, 2), patch.origin) if "black_error" in plan.effects else 0.0
        return np.zeros((2, patch.width)) + temporal, np.zeros((2, 2)) + errors + dark

    @property
    def farthest_dark_dn(self) -> float:
        """Largest value of a dark frame at sites that are checked, DN above its black level; hot pixels have more."""
        return NORMAL_DISTANCE * math.sqrt(max(self.plan.b_dn2, 0.0)) if self.plan.dark_frame else 0.0

    def offsets(self, height: int, width: int) -> NDArray[np.float32]:
        """Return what is known to be added to the noisy frame, DN.

        Parameters
        ----------
        height, width : int
            Size of the part of the patch that is checked, from its first site.

        Returns
        -------
        ndarray of float32, [2, W], or [H, W] with a dark frame
            NaN for sites that are not checked.
        """
        offsets = self.offset_dn[:, :width].astype(np.float32)
        if not self.plan.dark_frame:
            return offsets
        dark = reference.dark_frame_offsets(self.plan, self._dark_pixels, (height, width), self._patch.origin)
        dark[np.abs(dark) > self.farthest_dark_dn] = np.nan
        dark[0::2] += offsets[0]
        dark[1::2] += offsets[1]
        return dark

    def signal(self, clean_dn: Float, site: tuple[int, int]) -> Float:
        """Return the signal above black that causes shot noise, for DN of the clean frame at a site of the tile."""
        return np.asarray(np.maximum(clean_dn - self.plan.black_level_dn - self._clean_offset_dn[site], 0.0))

    def variance(self, signal: Float) -> Float:
        """Return the variance of the noise without outliers, DN²."""
        return sum((term.variance(signal) for term in (*self._temporal, *self._fixed)), np.zeros_like(signal))

    def fixed_variance(self, signal: Float) -> Float:
        """Return the part of the variance that frames of one body share, DN²."""
        return sum((term.variance(signal) for term in self._fixed), np.zeros_like(signal))

    def factors(self, signal: Float, tau: Float) -> Factors:
        """Return the factors of the characteristic function for each signal and frequency (radians per DN)."""
        temporal, fixed = (_product(terms, signal, tau) for terms in (self._temporal, self._fixed))
        if self.hot.share and self.hot.value_dn:
            gain = _physics(self.plan).dn_per_e
            mean_e = self.hot.value_dn / gain
            fixed = fixed * (1 - self.hot.share + self.hot.share / (1 - mean_e * np.expm1(1j * gain * tau)))
        value = temporal * fixed
        if self.dead.share:
            dead_dn = self.dead.value_dn - signal - self.plan.black_level_dn
            value = (1 - self.dead.share) * value + self.dead.share * np.exp(1j * tau * dead_dn)
        return Factors(signal, tau, temporal, fixed, value)

    def is_far_from_limits(self, clean_dn: Float, site: tuple[int, int]) -> NDArray[np.bool_]:
        """Return for which clean DN noise reaches no limit of the sensor, except in about `RARE` of the sites."""
        plan = self.plan
        u = self.signal(clean_dn, site)
        read_dn, read_distance = self._read_distance()
        other = np.sqrt(np.maximum(self.variance(u) - read_dn * read_dn, 0.0))
        offset_dn = np.abs(self.offset_dn).max(initial=0.0) + self.farthest_dark_dn
        distance = NORMAL_DISTANCE * other + read_distance * read_dn + offset_dn
        low, high = self.limits
        far = (clean_dn - distance > low) & (clean_dn + distance < high) & (clean_dn < plan.brightest_dn - 0.5)
        if plan.averaged:
            far &= clean_dn > max(low, 0.0)  # dead pixels
        if "full_well" in plan.effects:
            shot = NORMAL_DISTANCE * np.sqrt(_physics(plan).dn_per_e * u) + NORMAL_DISTANCE * np.sqrt(
                self.fixed_variance(u)
            )
            far &= u + shot < _physics(plan).full_well_e * _physics(plan).dn_per_e
        return np.asarray(far)

    def _read_distance(self) -> tuple[float, float]:
        physics = self.plan.physics
        if physics is None or physics.read_law == "gaussian" or "read" not in self.plan.effects:
            return 0.0, 0.0
        return physics.read_std_dn, max(
            NORMAL_DISTANCE, -tukey_quantile(RARE, physics.read_shape) / float(tukey_std(physics.read_shape))
        )


# --------------------------------------------------------------------------------------------------- Tukey's lambda law

LEAST_TAIL = 2.0**-33
"""Least tail probability of a random word."""

_FREQUENCIES = np.linspace(0.0, 4.5, 451)
"""Frequencies, in radians per standard deviation, at which the characteristic function of read noise is tabulated.

Those of cos 4z, the highest that is computed, are at most 4, because read noise is a part of all noise.
"""


def tukey_factor(frequency: Float, law: str, shape: float) -> Float:
    """Return the characteristic function of Tukey's lambda distribution, as read noise is drawn.

    Parameters
    ----------
    frequency : ndarray of float64
        Radians per standard deviation.
    law : str
        ``"tukey_lambda"``: its draws have standard deviation 1. ``"tukey"`` (version 0.1): the distribution has, and
        its draws have less, because tail probabilities below 2**-33 are not drawn.
    shape : float
        The distribution's λ.

    Returns
    -------
    ndarray of float64
        E[cos(frequency · n)]; absolute error below 3e-4 for shapes from -0.4. Frequencies above 4.5 count as 4.5.
    """
    return np.asarray(np.interp(np.abs(frequency), _FREQUENCIES, _tukey_table(law, shape)))


@functools.lru_cache(maxsize=256)
def _tukey_table(law: str, shape: float) -> Float:
    """Return ∫cos(ω·Q(p))dp at `_FREQUENCIES`.

    The trapezoidal rule in the logit of p converges quickly: 501 nodes have an error below 3e-6 for shapes from -0.4.
    """
    values, weights = _quantiles(shape, -25.0, 501)
    if law == "tukey":
        std = float(tukey_std(shape))
    else:  # the square of the quantile function needs nodes farther out
        some, of_some = _quantiles(shape, -40.0, 1601)
        std = math.sqrt(float((some * some) @ of_some))
    return np.asarray(np.cos(np.outer(_FREQUENCIES, values / std)) @ weights)


def _quantiles(shape: float, lowest: float, count: int) -> tuple[Float, Float]:
    """Return the quantiles of Tukey's lambda distribution at logits from ``lowest`` to 0, and the nodes' weights."""
    logit = np.linspace(lowest, 0.0, count)
    p = 1 / (1 + np.exp(-logit))
    weights = 2 * (logit[1] - logit[0]) * p * (1 - p)  # both halves: the distribution is symmetric
    weights[-1] /= 2
    return tukey_quantile(np.maximum(p, LEAST_TAIL), shape), weights


def tukey_quantile(p: Any, shape: float) -> Any:
    """Return the quantile of Tukey's lambda distribution of scale 1."""
    return np.log(p / (1 - p)) if abs(shape) < LOGISTIC else (p**shape - (1 - p) ** shape) / shape
