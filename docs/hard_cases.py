"""Measure the errors on the page hard_cases.md: obvious form and the form that the package uses, for each case.

``python docs/hard_cases.py`` measures, and rewrites the tables of the page; it takes about half a minute. Truth is
computed with mpmath, exact fractions or integers. A test compares the page with new measurements.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from decimal import Decimal
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import mpmath
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.exact_distributions import tukey_quantile
from unprocess_gen.simulation.lookup_tables import normal_table, tukey_table
from unprocess_gen.simulation.reference import colour, isp
from unprocess_gen.simulation.reference.noise import by_inverse_cdf
from unprocess_gen.simulation.reference.poisson import poisson
from unprocess_gen.simulation.reference.unprocess import apply_ccm, inverse_smoothstep, invert_gains_per_channel
from unprocess_gen.simulation.tone_curves import linear_table
from unprocess_gen.sources.dark_frames import trimmed_moments
from unprocess_gen.sources.loader import downscaled

PAGE = Path(__file__).parent / "hard_cases.md"
mpmath.mp.dps = 50

Array = NDArray[Any]
Figures = tuple[float, float | None]
"""Figure of the obvious form and of the form used; None if a test of the package shows the latter."""

SENSORS = {10: (64, 1023), 12: (240, 4095), 14: (1024, 16383), 16: (4096, 65535)}
"""Black and white level of sensors in conf/sensor, by bits; 12 bits: imx385_12bit."""


class Case(NamedTuple):
    """Hold a hard case.

    ``is_exact`` means that the figures depend only on operations which every machine rounds alike.
    """

    section: str
    quantity: str
    obvious: str
    used: str
    is_exact: bool
    measure: Callable[[], Figures]


CASES: list[Case] = []


def case(section: str, quantity: str, obvious: str, used: str, is_exact: bool = True) -> Any:
    """Return a decorator that adds a measurement to `CASES`."""

    def add(measure: Callable[[], Figures]) -> Callable[[], Figures]:
        CASES.append(Case(section, quantity, obvious, used, is_exact, measure))
        return measure

    return add


def relative_error(values: Array, truth: list[Any]) -> float:
    """Return the largest relative error."""
    return float(max(abs(mpmath.mpf(float(value)) / true - 1) for value, true in zip(values, truth, strict=True)))


def random(key: int) -> np.random.Generator:
    """Return a generator whose numbers are the same on every machine."""
    return np.random.Generator(np.random.Philox(key=key))


# -------------------------------------------------------------------------------------------------------------- curves


@cache
def true_curve(top: int, gamma: str) -> tuple[list[int], list[Any]]:
    """Return codes k and (inverse smoothstep of k / top) ** gamma with 50 digits; a sample of 16-bit codes."""
    step = 1 if top == 255 else 97
    codes = sorted({*range(1, top, step), 1, 2, 3, top - 2, top - 1})
    return codes, [
        (mpmath.mpf(1) / 2 - mpmath.sin(mpmath.asin(1 - 2 * mpmath.mpf(code) / top) / 3)) ** mpmath.mpf(gamma)
        for code in codes
    ]


def arcsine(x: Array) -> Array:
    """Return the inverse tone curve as the article writes it."""
    half, one, two, three = (x.dtype.type(value) for value in (0.5, 1, 2, 3))
    return half - np.sin(np.arcsin(one - two * x) / three)


def inverse_tone(top: int, dtype: type) -> Callable[[], Figures]:
    """Measure the arcsine form and the reflected form on the darker half of the codes."""

    def measure() -> Figures:
        codes, truth = true_curve(top, "1")
        k = np.array([code for code in codes if 2 * code < top])
        true = truth[: len(k)]
        stable = reflected(k, top, dtype)
        return relative_error(arcsine((k / top).astype(dtype)), true), relative_error(stable, true)

    return measure


TONES = (("16-bit", 65535, np.float64),)
for _name, _top, _dtype in TONES:
    _quantity = f"relative error of the inverse tone curve, {_name} codes below ½"
    case("curves", _quantity, "½ − sin(asin(1 − 2x) / 3)", "sin t·(√3·cos t + sin t)", is_exact=False)(
        inverse_tone(_top, _dtype)
    )


def reflected(k: Array, top: int, dtype: type) -> Array:
    """Return the inverse tone curve without cancellation; bright codes are reflected as integers."""
    return inverse_smoothstep((k / top).astype(dtype), ((top - k) / top).astype(dtype))


@case("curves", "light of black", "½ − sin(asin(1) / 3)", "table", is_exact=False)
def tone_at_zero() -> Figures:
    """Return the light of black."""
    return float(arcsine(np.zeros(1))[0]), float(linear_table("smoothstep", 2.2, 256)[0])


def curve_table(top: int) -> Callable[[], Figures]:
    """Measure tone and gamma together: formulas in float64, and the table."""

    def measure() -> Figures:
        codes, truth = true_curve(top, "2.2")
        k = np.array(codes)
        table = linear_table("smoothstep", 2.2, top + 1)[k]
        return relative_error(arcsine(k / top) ** 2.2, truth), relative_error(table, truth)

    return measure


for _name, _top in (("16-bit", 65535),):
    case("curves", f"relative error of tone curve and gamma, {_name} codes", "formulas", "table", is_exact=False)(
        curve_table(_top)
    )


@case("curves", "wrong DN, 65,536 codes on four sensors", "formulas in float32", "formulas in float64", is_exact=False)
def curve_dn() -> Figures:
    """Count the DN on four sensors that differ from those of the table: float32 formulas, float64 formulas."""
    k, top = np.arange(65536), 65535
    table = linear_table("smoothstep", 2.2, 65536)
    single = np.maximum(arcsine((k / top).astype(np.float32)), np.float32(0)) ** np.float32(2.2)
    double = np.maximum(arcsine(k / top), 0) ** 2.2
    wrong = [0, 0]
    for black, white in SENSORS.values():
        exact = np.rint(table * (white - black) + black)
        wrong[0] += int((np.rint(single * np.float32(white - black) + np.float32(black)) != exact).sum())
        wrong[1] += int((np.rint(double * (white - black) + black) != exact).sum())
    return float(wrong[0]), float(wrong[1])


# ------------------------------------------------------------------------------------------------------ colour and gain


@cache
def mixes() -> list[colour.Matrix]:
    """Return XYZ → camera matrices of 500 random mixes of the four cameras."""
    weights = random(1).random((500, 4))
    return [colour.mix(list(colour.CAMERAS.values()), (one / one.sum()).tolist()) for one in weights]


@case("colour", "channels in which white is not exactly 1, %", "rows divided by their sum", "rows on a grid")
def white_through_matrix() -> Figures:
    """Return the share of channels in which white is not exactly 1, in percent; additions from left to right."""
    wrong = [0, 0]
    for xyz2cam in mixes():
        product = colour.multiply(xyz2cam, colour.RGB2XYZ)
        rows = [product[at : at + 3] for at in (0, 3, 6)]
        divided = [[entry / (row[0] + row[1] + row[2]) for entry in row] for row in rows]
        ours = colour.rgb2cam(xyz2cam)
        wrong[0] += sum((row[0] + row[1]) + row[2] != 1 for row in divided)
        for at in (0, 3, 6):
            r, g, b = ours[at : at + 3]
            wrong[1] += len({(r + g) + b, r + (g + b), (r + b) + g} - {1.0})
    return wrong[0] / 15, wrong[1] / 15


@case("colour", "gains for which white is not exactly 1, %", "100·(i − 0.9)²", "((i − 0.9) / (1 − 0.9))²")
def white_through_highlights() -> Figures:
    """Return the share of gains below 1 for which white is not exactly 1, in percent."""
    k, one = random(2).random(100_000), np.ones(1)
    article = one * k + 100 * one * (one - 0.9) ** 2 * (1 - k)
    return float((article != 1).mean() * 100), float((invert_gains_per_channel(one, k, 0.9) != 1).mean() * 100)


@case(
    "colour",
    "step between the two brightest codes, DN at 14 bits, inverse gain 0.2083",
    "8-bit source",
    "16-bit source",
)
def highlight_step() -> Figures:
    """Return the distance of codes 254 and 255 in the raw frame, 14 bits, DN: gain 0.2083 as red at the mean gains."""
    light = linear_table("smoothstep", 2.2, 256)[[254, 255]]
    deep = linear_table("smoothstep", 2.2, 65536)[[65534, 65535]]
    steps = [np.diff(invert_gains_per_channel(one, np.array(0.2083), 0.9))[0] * 15359 for one in (light, deep)]
    return float(steps[0]), float(steps[1])


def highlight_inverse(k: float) -> Callable[[], Figures]:
    """Measure the inverse of the highlight function for gain ``k``: Cardano, and Newton from above."""

    def measure() -> Figures:
        threshold, width = 0.9, 1 - mpmath.mpf(0.9)
        i = np.concatenate([0.9 + 10.0 ** -np.arange(2, 13), np.linspace(0.901, 1, 40)])
        y = [float(one * k + one * ((one - threshold) / width) ** 2 * (1 - mpmath.mpf(k))) for one in i.tolist()]

        def missing(y: float) -> Callable[[Any], Any]:
            return lambda one: one * k + one * ((one - threshold) / width) ** 2 * (1 - mpmath.mpf(k)) - y

        truth = [mpmath.findroot(missing(light), one) for light, one in zip(y, i.tolist(), strict=True)]
        cardano = np.array([largest_root(k, threshold, light) for light in y])
        newton = isp.apply_gains_per_channel(np.array(y), np.array(k), threshold)
        return relative_error(cardano, truth), relative_error(newton, truth)

    return measure


def largest_root(k: float, threshold: float, y: float) -> float:
    """Solve k·i + (1 - k)·i·((i - threshold) / (1 - threshold))² = y by Cardano's formula in float64.

    Divided by the factor of i³, and with i = t + 2·threshold / 3, it is t³ + p·t + q = 0.
    """
    factor = (1 - k) / (1 - threshold) ** 2
    p = k / factor - threshold**2 / 3
    q = 2 * threshold**3 / 27 + 2 * threshold * k / (3 * factor) - y / factor
    inside = q * q / 4 + p**3 / 27
    if inside < 0:  # three real roots
        cosine = 3 * q / (2 * p) * math.sqrt(-3 / p)
        t = 2 * math.sqrt(-p / 3) * math.cos(math.acos(max(-1.0, min(1.0, cosine))) / 3)
    else:
        t = math.cbrt(-q / 2 + math.sqrt(inside)) + math.cbrt(-q / 2 - math.sqrt(inside))
    return t + 2 * threshold / 3


for _name, _gain in (("1 − 1e-9", 1 - 1e-9),):
    case("colour", f"relative error of its inverse, gain {_name}", "Cardano", "Newton from above", is_exact=False)(
        highlight_inverse(_gain)
    )


@case("machines", "sums of three products that change, %", "another order", "fixed order")
def order_of_additions() -> Figures:
    """Return the share of sums of three products that change with the order of additions, in percent."""
    rgb = linear_table("smoothstep", 2.2, 256)[random(4).integers(0, 256, (100_000, 3))]
    ccm = colour.rgb2cam(colour.CAMERAS["sony_a7r"])
    r, g, b = (rgb[:, n] * ccm[n] for n in range(3))
    ours = apply_ccm(rgb, ccm)[:, 0]
    return float((r + (g + b) != ours).mean() * 100), float(((r + g) + b != ours).mean() * 100)


@case("machines", "sums of two products that change, %", "fused multiply-add", "two roundings")
def fused_multiply_add() -> Figures:
    """Return the share of sums a·x + b·y that a fused multiply-add rounds differently, in percent."""
    x = linear_table("smoothstep", 2.2, 256)[random(5).integers(1, 255, (5000, 2))].tolist()
    a, b = colour.rgb2cam(colour.CAMERAS["sony_a7r"])[:2]
    fused = [float(Fraction(a) * Fraction(one) + Fraction(b * two)) for one, two in x]
    plain = [a * one + b * two for one, two in x]
    return float(np.mean(np.array(fused) != np.array(plain)) * 100), None


@case("machines", "values that change without AVX2 and AVX-512, %", "NumPy: x**2.2", "NumPy: arcsin(x)", is_exact=False)
def libm_power() -> Figures:
    """Return the share of NumPy's x**2.2 and arcsin(x) that change without AVX-512 and AVX2, in percent."""
    program = (
        "import numpy as n, sys; x = n.linspace(0.001, 1, 100000);"
        "sys.stdout.buffer.write((x ** 2.2).tobytes() + n.arcsin(x).tobytes())"
    )
    found = []
    for features in ("", "X86_V4 X86_V3 AVX512_ICL AVX512_SPR"):
        env = {**os.environ, "NPY_DISABLE_CPU_FEATURES": features}
        done = subprocess.run([sys.executable, "-W", "ignore", "-c", program], env=env, capture_output=True, check=True)
        found.append(np.frombuffer(done.stdout).reshape(2, -1))
    power, sine = (found[0] != found[1]).mean(axis=1) * 100
    return float(power), float(sine)


# ------------------------------------------------------------------------------------------------------------- rounding


@case("rounding", "bias, DN", "truncation", "rounding")
def truncation() -> Figures:
    """Return the bias of truncation and of rounding, DN: mean over a signal with noise of 5 DN."""
    values = 500 + 5 * by_inverse_cdf(words(2**18), normal_table())
    exact = values.mean()
    return float(np.floor(values).mean() - exact), float(np.rint(values).mean() - exact)


@case("rounding", "error beyond half a DN", "floor(x + ½)", "rint")
def half_up() -> Figures:
    """Return the error of floor(x + ½) and of rint just below ½, in DN beyond the half that is allowed."""
    x = np.array([np.nextafter(0.5, 0), 2.0**52 + 1])
    return float((np.abs(np.floor(x + 0.5) - x) - 0.5).max()), float(max((np.abs(np.rint(x) - x) - 0.5).max(), 0.0))


@case("rounding", "bias of exact ties, DN", "half up", "half to even")
def half_ties() -> Figures:
    """Return the bias of rounding exact ties (0.5, 1.5, 2.5, …), DN: half up, half to even."""
    ties = np.arange(1000) + 0.5
    return float((np.floor(ties + 0.5) - ties).mean()), float((np.rint(ties) - ties).mean())


@case("rounding", "bias of black pixels with read noise of 6.2 DN, DN", "clip at black", "clip at 0")
def clip_bias() -> Figures:
    """Return the bias of black pixels for read noise of 6.17 DN, DN: clipped at black (240), clipped at 0."""
    density, tail = mpmath.npdf, mpmath.ncdf
    sigma = mpmath.sqrt(mpmath.mpf("38.117816"))
    biases = [sigma * (density(t) - t * tail(-t)) for t in (mpmath.mpf(0), 240 / sigma)]
    return float(biases[0]), float(biases[1])


@case(
    "rounding",
    "variance that rounding adds to noisy − clean, DN²",
    "x between integers",
    "x an integer",
)
def rounding_variance() -> Figures:
    """Return the variance that rounding adds to noisy minus clean, for many fractions of x, then for an integer."""
    noise = 6.18 * by_inverse_cdf(words(2**20), normal_table())
    added = [(np.rint(x + noise) - np.rint(x)).var() - noise.var() for x in (random(10).random(2**20), 0.0)]
    return float(added[0]), float(added[1])


@case("rounding", "clipped sites that are counted at an exposure ratio of 10, %", "after the ratio", "before the ratio")
def clipping_before_ratio() -> Figures:
    """Return how much light from 0 to 1.12 is counted as clipped at white: divided by the ratio first, then ours."""
    light = random(11).random(2**20) * 1.12
    return float((light / 10 > 1).mean() * 100), float((light > 1).mean() * 100)


# ---------------------------------------------------------------------------------------------------------------- noise


@case(
    "noise",
    "standard deviation at black (IMX385, ISO 1600), relative to its calibration",
    "a·raw + b",
    "a·(raw − black) + b",
)
def included_black() -> Figures:
    """Return the standard deviation at black relative to CRVD's (ISO 1600, black level 240): a·raw + b, then ours."""
    a, b = 3.513262, 11.917691
    return math.sqrt((a * 240 + b) / b), 1.0


@case("noise", "variance at black of the line of RVDD, ISO 3200, DN²", "as published", "negative_variance: clip")
def negative_variance() -> Figures:
    """Return the variance at black of the line for ISO 3200 in RVDD, DN²: as published, and clipped."""
    variance = 8.0034 * 240 - 2043.51144
    return variance, max(variance, 0.0)


@case("noise", "relative error of √(a·x + b) within 0.05 DN of zero variance", "float32", "float64")
def cancelled_variance() -> Figures:
    """Measure √(a·x + b) near zero variance (RVDD, ISO 3200): float32, and float64."""
    a, b = 8.0034, 8.0034 * 240 - 2043.51144
    x = np.linspace(-b / a + 1e-4, -b / a + 0.05, 500).astype(np.float32).astype(np.float64)
    truth = [mpmath.sqrt(mpmath.mpf(a) * mpmath.mpf(float(one)) + mpmath.mpf(b)) for one in x]
    single = np.sqrt(np.maximum(np.float32(a) * x.astype(np.float32) + np.float32(b), 0))
    return relative_error(single, truth), relative_error(np.sqrt(a * x + b), truth)


def words(count: int) -> NDArray[np.uint32]:
    """Return random words, evenly spaced and shuffled by an odd factor."""
    return np.arange(count, dtype=np.uint32) * np.uint32(2654435761) + np.uint32(2**31 // count)


@case("noise", "words of 2^32 whose deviate is infinite", "float32: word / 2^32", "(i + ½) / 2^32 and sign")
def float32_uniforms() -> Figures:
    """Return how many of the 2^32 words give an infinite normal deviate."""
    last = np.arange(2**32 - 1024, 2**32, dtype=np.uint64)
    ones = int(((last.astype(np.float64) / 2**32).astype(np.float32) == 1).sum())
    ends = np.array([0, 2**31 - 1, 2**31, 2**32 - 1], dtype=np.uint32)
    return ones + 1.0, float((~np.isfinite(by_inverse_cdf(ends, normal_table()))).sum())


@case("noise", "error of a normal deviate, standard deviations", "sum of 12 uniforms − 6", "1024 quadratics")
def quantile_error() -> Figures:
    """Measure normal quantiles in standard deviations: the sum of 12 uniforms minus 6, then ours (200 words)."""
    index = np.unique(np.geomspace(1, 2**31 - 1, 200).astype(np.uint32))
    tail = [(mpmath.mpf(int(one)) + mpmath.mpf("0.5")) / 2**32 for one in index]
    truth = [mpmath.sqrt(2) * mpmath.erfinv(1 - 2 * one) for one in tail]
    ours = by_inverse_cdf(index, normal_table())
    errors = [abs(z - true) for z, true in zip(map(float, ours), truth, strict=True)]
    return float(truth[0]) - 6, float(max(errors))


def poisson_cdf(rate: float, counts: Iterable[int]) -> list[Any]:
    """Return P(K <= k) with 50 digits."""
    return [mpmath.gammainc(k + 1, rate, mpmath.inf, regularized=True) for k in counts]


def gaussian_for_poisson(rate: float) -> Callable[[], Figures]:
    """Measure the largest difference of distribution functions: a rounded normal, then ours."""

    def measure() -> Figures:
        spread = int(9 * math.sqrt(rate)) + 12
        counts = range(max(0, int(rate) - spread), int(rate) + spread)
        exact = poisson_cdf(rate, counts)
        rounded = [mpmath.ncdf((k + 0.5 - rate) / mpmath.sqrt(rate)) for k in counts]
        obvious = max(abs(one - other) for one, other in zip(rounded, exact, strict=True))
        return float(obvious), law_error(
            rate, [k for k, cdf in zip(counts, exact, strict=True) if 1e-8 < cdf < 1 - 1e-8]
        )

    return measure


for _rate in (1.0, 1000.0):
    case("noise", f"error of P(K ≤ k) at rate {_rate:g}", "rounded normal", "inversion", is_exact=False)(
        gaussian_for_poisson(_rate)
    )


def law_error(rate: float, counts: list[int]) -> float:
    """Return the largest difference between the share of words that give k or less and P(K <= k)."""
    low, high = np.zeros(len(counts), dtype=np.int64), np.full(len(counts), 2**32, dtype=np.int64)
    k = np.array(counts)
    while (low < high).any():
        middle = (low + high) // 2
        rank = np.minimum(middle, 2**32 - 1)
        word = np.where(rank < 2**31, rank + 2**31, 2**32 - 1 - rank).astype(np.uint32)
        up = (poisson(word, np.full(len(k), float(rate))) <= k) & (low < high)
        low, high = np.where(up, middle + 1, low), np.where(up, high, np.minimum(high, middle))
    exact = poisson_cdf(rate, counts)
    return float(max(abs(mpmath.mpf(int(share)) / 2**32 - cdf) for share, cdf in zip(low, exact, strict=True)))


@case("noise", "error of P(K ≤ k) at rate 50", "probabilities summed in float32", "tables with derivatives")
def summed_cdf() -> Figures:
    """Measure P(K <= k) at rate 50: probabilities summed in float32, then ours."""
    rate, counts = 50.0, range(128)
    share = np.array([math.exp(-rate)] + [0.0] * 127)
    for k in range(1, 128):
        share[k] = share[k - 1] * rate / k
    single = np.cumsum(share.astype(np.float32), dtype=np.float32)
    exact = poisson_cdf(rate, counts)
    wrong = max(abs(mpmath.mpf(float(one)) - cdf) for one, cdf in zip(single, exact, strict=True))
    return float(wrong), law_error(rate, list(range(20, 95)))


@case("noise", "variance / rate", "NumPy at 1e15", "at the limit of 1e9")
def huge_rate() -> Figures:
    """Return variance over rate of NumPy's Poisson numbers at rate 1e15, and of ours at the limit of 1e9."""
    drawn = random(7).poisson(1e15, 200_000).astype(np.float64) - 1e15
    ours = poisson(words(2**18), np.full(2**18, 1e9)) - 1e9
    return float(drawn.var() / 1e15), float(ours.var() / 1e9)


@case(
    "noise", "relative error of Tukey's quantile, shapes 1e-4 to 1e-11", "float64", "decimal, 40 digits", is_exact=False
)
def tukey_near_zero() -> Figures:
    """Measure Tukey's quantile ((1-p)^s - p^s) / s for shapes s of 1e-4 to 1e-11: float64, then ours (decimal)."""
    worst = [0.0, 0.0]
    for exponent in range(4, 12):
        shape, p = 10.0**-exponent, 0.25
        power = mpmath.mpf(shape)
        true = (mpmath.mpf(0.75) ** power - mpmath.mpf(0.25) ** power) / power
        ours = mpmath.mpf(str(tukey_quantile(Decimal("0.25"), shape)))
        plain = ((1 - p) ** shape - p**shape) / shape
        worst = [max(worst[0], float(abs(plain / true - 1))), max(worst[1], float(abs(ours / true - 1)))]
    return worst[0], worst[1]


@case(
    "noise",
    "standard deviation of Tukey's distribution with shape −0.2429 that should be 1",
    "scale 1",
    "scale 1 / deviation",
)
def tukey_scale() -> Figures:
    """Return the standard deviation of Tukey's distribution with shape -0.2429: scale taken for it, then ours."""
    table = tukey_table(-0.2429)
    values = by_inverse_cdf(words(2**18), table)
    shape = mpmath.mpf("-0.2429")
    beta = mpmath.gamma(shape + 1) ** 2 / mpmath.gamma(2 * shape + 2)
    return float(mpmath.sqrt(2 / shape**2 * (1 / (1 + 2 * shape) - beta))), float(values.std())


@case("noise", "clean value at a full well of 10,000 e⁻, electrons from it", "mean of clipped frames", "clipped mean")
def full_well_mean() -> Figures:
    """Return the mean of frames at a full well of 10,000 e⁻ with shot noise, electrons from it: clipped each, mean."""
    drawn = poisson(words(2**18), np.full(2**18, 10_000.0))
    return float(np.minimum(drawn, 10_000).mean() - 10_000), float(np.minimum(10_000.0, 10_000) - 10_000)


@case(
    "noise",
    "black level of dark frames with a mean of 14.76 DN, DN from it",
    "median",
    "trimmed mean",
)
def fractional_black() -> Figures:
    """Return the error of the black level of frames with a fractional mean: median, then mean."""
    frame = np.rint(14.76 + 3.09 * by_inverse_cdf(words(2**20), normal_table())).clip(0).astype(np.int64)
    frame[:: 2**14] = 4000  # hot pixels
    mean_dn, _ = trimmed_moments(np.bincount(frame))
    return float(np.median(frame)) - 14.76, mean_dn - 14.76


# --------------------------------------------------------------------------------------------------------------- others


@case("machines", "clean values that change at 16 bits, %", "float32", "float64")
def float32_pair() -> Figures:
    """Return the share of clean values that change in plain float32, 16-bit sensor, in percent; then those of ours."""
    codes = random(8).integers(0, 256, (2**19, 3))
    table, ccm = linear_table("smoothstep", 2.2, 256), colour.rgb2cam(colour.CAMERAS["sony_a7r"])
    light = apply_ccm(table[codes], ccm)[:, 1] * 0.8
    single = table.astype(np.float32)[codes]
    sums = sum(single[:, n] * np.float32(ccm[3 + n]) for n in range(3)) * np.float32(0.8)
    exact, plain = np.rint(light * 61439 + 4096), np.rint(sums * np.float32(61439) + np.float32(4096))
    return float((exact != plain).mean() * 100), None


@case("images", "half an 8-bit code, DN at 14 bits", "at code 254", "at code 128")
def dithered_highlight() -> Figures:
    """Return what half an 8-bit code is worth, DN at 14 bits without gains: at code 254, and at code 128."""
    table = linear_table("smoothstep", 2.2, 65536) * 15359
    return float(table[254 * 257 + 128] - table[254 * 257]), float(table[128 * 257 + 128] - table[128 * 257])


@case("images", "means of 64 × 64 codes of 16 bits that are not the nearest code, %", "float32 sums", "integers")
def float_averages() -> Figures:
    """Return how many of 4096 means of 64 x 64 16-bit codes are not the nearest code: summed in float32, then ours."""
    codes = random(9).integers(0, 65536, (512, 512, 3)).astype(np.uint16)
    squares = codes.reshape(8, 64, 8, 64, 3)
    sums = squares.astype(np.uint64).sum(axis=(1, 3))
    nearest = (2 * sums + 4096) // 8192
    single = np.zeros(nearest.shape, dtype=np.float32)
    for y in range(64):
        for x in range(64):
            single = single + squares[:, y, :, x].astype(np.float32)
    plain = np.floor(single / np.float32(4096) + np.float32(0.5)).astype(np.uint64)
    ours = downscaled(codes, 64)
    return float((plain != nearest).mean() * 100), float((ours != nearest).mean() * 100)


@case("images", "levels that 256 gray codes have at 14 bits", "exposure ratio 300", "exposure ratio 1")
def dark_levels() -> Figures:
    """Return how many of the 256 gray codes keep a level of their own, 14 bits, ratio 300: rounded once; ratio 1."""
    table = linear_table("smoothstep", 2.2, 256)
    levels = [len(np.unique(np.rint(table * 0.8 / ratio * 15359 + 1024))) for ratio in (300, 1)]
    return float(levels[0]), float(levels[1])


# ---------------------------------------------------------------------------------------------------------------- page


def shown(figure: float | None) -> str:
    """Return a figure with two digits; integers in full."""
    if figure is None:
        return "see the tests"
    if figure == int(figure) and abs(figure) < 1e6:
        return str(int(figure))
    return f"{figure:.2g}" if abs(figure) < 1 or abs(figure) >= 1e6 else f"{figure:.3g}"


def row(one: Case) -> str:
    """Measure a case, and return its row of the table."""
    with np.errstate(under="ignore"):
        obvious, used = one.measure()
    return f"| {one.quantity} | {one.obvious}: {shown(obvious)} | {one.used}: {shown(used)} |"


def marks(section: str) -> re.Pattern[str]:
    """Return the pattern of a section's table in the page."""
    return re.compile(rf"(<!-- {section}: from hard_cases.py -->\n).*?(<!-- end of {section} -->)", re.DOTALL)


def table(section: str) -> str:
    """Return the table of a section."""
    rows = [row(one) for one in CASES if one.section == section]
    return "\n".join(["| quantity | obvious form | here |", "|---|---|---|", *rows])


def main() -> None:
    """Measure all cases, print their tables and rewrite the page."""
    text = PAGE.read_text(encoding="utf-8")
    for section in dict.fromkeys(one.section for one in CASES):
        made = table(section)
        print(made, end="\n\n")
        text = marks(section).sub(lambda found, made=made: found[1] + made + "\n" + found[2], text)
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
