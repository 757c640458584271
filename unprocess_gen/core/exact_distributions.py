"""Distribution functions and quantiles in `decimal`: identical digits on every machine.

NumPy's and libm's exponentials, logarithms and powers differ in the last bit between machines. `decimal` uses integer
arithmetic only. The functions return about 25 correct digits or more; the caller rounds once to float64.
"""

from __future__ import annotations

import functools
from decimal import Decimal, localcontext
from statistics import NormalDist

DIGITS = 40
"""Digits of the decimal context in which functions and tables are computed."""

PI = Decimal("3.14159265358979323846264338327950288419716939937510582")

LOGISTIC = 1e-12
"""A Tukey-lambda shape nearer to 0 than this is treated as 0; float64 cannot represent the difference."""


@functools.lru_cache(maxsize=1024)
def power_of_two(exponent: float) -> float:
    """2 to a power, correctly rounded."""
    with localcontext(prec=DIGITS):
        return float(Decimal(2) ** Decimal(exponent))


def normal_quantile(p: Decimal) -> Decimal:
    """Quantile of the standard normal distribution with at least 23 correct digits: Newton's method on `normal_cdf`.

    ``p`` is a probability in [2**-53, 1 - 2**-53].
    """
    with localcontext(prec=DIGITS):
        z = Decimal(NormalDist().inv_cdf(float(p)))
        for _ in range(2):
            z -= (normal_cdf(z) - p) / normal_density(z)
        return z


def normal_density(z: Decimal) -> Decimal:
    """Standard normal density, in the precision of the current decimal context."""
    return (-z * z / 2).exp() / (2 * PI).sqrt()


def normal_cdf(z: Decimal) -> Decimal:
    """Standard normal distribution function at |z| ≤ 8, in the precision of the current decimal context.

    Φ(z) = ½ + φ(z)·(z + z³/3 + z⁵/(3·5) + …) (Abramowitz and Stegun 26.2.11).
    """
    term = total = z
    k, least = 1, Decimal(10) ** -(DIGITS + 2)
    while abs(term) > least:
        k += 2
        term = term * z * z / k
        total += term
    return Decimal("0.5") + normal_density(z) * total


def tukey_quantile(tail: Decimal, shape: float) -> Decimal:
    """Quantile 1 - ``tail`` of Tukey's lambda distribution of scale 1, in the current decimal context.

    It is ((1 - tail)**shape - tail**shape) / shape, or ln((1 - tail) / tail) for shape 0, the logistic distribution.
    """
    if abs(shape) < LOGISTIC:
        return ((1 - tail) / tail).ln()
    power = Decimal(shape)
    return ((power * (1 - tail).ln()).exp() - (power * tail.ln()).exp()) / power


def tukey_std(shape: float) -> Decimal:
    """Standard deviation of Tukey's lambda distribution of scale 1 for λ > -½, in the current decimal context.

    √(2/λ² · (1/(1 + 2λ) - Γ(λ + 1)²/Γ(2λ + 2))), and π/√3 for λ = 0 (Joiner and Rosenblatt, JASA 1971).
    """
    if abs(shape) < LOGISTIC:
        return PI / Decimal(3).sqrt()
    power = Decimal(shape)
    beta = (2 * _log_gamma(power + 1) - _log_gamma(2 * power + 2)).exp()
    return (2 / power**2 * (1 / (1 + 2 * power) - beta)).sqrt()


_BERNOULLI = ((1, 6), (-1, 30), (1, 42), (-1, 30), (5, 66), (-691, 2730), (7, 6), (-3617, 510), (43867, 798))
_SHIFT = 60


def _log_gamma(x: Decimal) -> Decimal:
    """ln Γ(x) for x > 0 by Stirling's series at x + 60, whose ninth term is below 1e-30."""
    product = Decimal(1)
    for step in range(_SHIFT):
        product *= x + step
    far = x + _SHIFT
    series = (far - Decimal("0.5")) * far.ln() - far + (2 * PI).ln() / 2
    for n, (top, bottom) in enumerate(_BERNOULLI, start=1):
        series += Decimal(top) / bottom / (2 * n * (2 * n - 1)) / far ** (2 * n - 1)
    return series - product.ln()
