"""Tables that are exact by construction: the curve from a code to linear light, and the normal quantiles.

No libm and no NumPy transcendental gives the same last bit on every machine, so nothing on the way to the output calls
one. Curves are computed in `decimal`, which is integer arithmetic, with 40 digits, and rounded once to float64: all 256
(or 65,536) entries are correctly rounded. That takes 30 ms for 8-bit sources and 7 s for 16-bit ones, which is
therefore kept in the user's cache folder; whoever needs it first builds it under a lock, the others wait and read.
The default curves' SHA-256 is pinned here, any other file carries its own.

The normal table serves the inverse-CDF sampler (`effects.normals`): 32 octaves of the tail probability, 32 segments
each, a quadratic per segment. Its error is below 1.5e-7 everywhere (the test walks it), 24 KB, so it stays in the
first-level cache. Tried: 16 segments 1.1e-6, 64 segments 1.8e-8 but 49 KB and 1.8 times slower.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal, localcontext
from pathlib import Path
from statistics import NormalDist

import numpy as np

from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.types import Float, gamma_text

DIGITS = 40
OCTAVES, SEGMENTS = 32, 32

PINNED = {
    # (tone, gamma, codes): SHA-256 of the little-endian doubles, for the curves that `conf/isp` offers.
    ("smoothstep", "2.2", 256): "d358dd03d38f763306ef83a982403114f2ff8e5397025f2c68dbe50e85503bfa",
    ("none", "2.2", 256): "d88862390e829fe50b30dad857e46bd483eba84df9360b31afd364070f23c73e",
    ("none", "srgb", 256): "50108edde31f5f4cb0697f42d7366a51efd4f0070109b257bf9132bf7293e2b4",
    ("none", "1", 256): "9eb7f1f01b639e68e5f9e5442b3512c457995d4a9a0f7911e541cd839b4ba055",
    ("smoothstep", "2.2", 65536): "0b4e6586b50ad74765f96580bfab938e3a533bc9483241cc642157054464c4af",
    ("none", "2.2", 65536): "9d8cd64fbd28b487e83708a1bf998cb59dcca50b531d72fb42987f2a1d2e2697",
    ("none", "srgb", 65536): "16e1d9575cec5ce1ebb97a0fe9866cf5d2c434696708e32ffa0364d683e116ed",
    ("none", "1", 65536): "71a3e67f3353f4a46ab0945c29cfcc7a0755e61bdee98cde71aa2a85f4681341",
}
NORMAL_SHA256 = "1de8806d2534020a52f8f25e981f0bc9f85f65e29bd634c29e7dc0820480ba5a"


def linear_table(tone: str, gamma: float | str, codes: int) -> Float:
    """Return the exact curve from code to linear light, float64 ``[codes]`` in [0, 1], read-only.

    ``tone`` is ``smoothstep`` or ``none``; ``gamma`` a power or ``srgb``; ``codes`` 256 or 65536. Entry k is the
    inverse tone curve of k / (codes - 1), expanded; the first entry is 0 and the last 1. Raises ValueError for other
    names and MachineError where a pinned curve does not come out as published.
    """
    if tone not in TONES:
        raise ValueError(f"tone is {tone!r}, expected one of {', '.join(TONES)}")
    return _linear_table(tone, gamma_text(gamma), codes)


def normal_table() -> Float:
    """Return the quadratics of the normal quantile, float64 ``[1024, 3]``, read-only.

    Row ``e * 32 + s`` covers j in [2**e * (1 + s/32), 2**e * (1 + (s+1)/32)), where the tail probability is
    p = j / 2**33; with t = j / 2**e - 1 - s/32 the quantile -Phi^-1(p) is c0 + t * (c1 + t * c2). MachineError where
    the table does not come out as published.
    """
    return _normal_table()


# ---------------------------------------------------------------------------------------------------------- curves


def smoothstep_inverse(x: Decimal) -> Decimal:
    """Return y in [0, 1] with 3y² - 2y³ = x, by Newton's method; x in [0, 1]."""
    if x > Decimal("0.5"):
        return 1 - smoothstep_inverse(1 - x)
    if x == 0:
        return x
    y = Decimal(2 * math.sin(math.asin(math.sqrt(x)) / 3) * math.cos(math.pi / 6 - math.asin(math.sqrt(x)) / 3))
    for _ in range(3):
        y -= (y * y * (3 - 2 * y) - x) / (6 * y * (1 - y))
    return y


def srgb_expand(v: Decimal) -> Decimal:
    """Return linear light of an sRGB value in [0, 1] (IEC 61966-2-1)."""
    if v <= Decimal("0.04045"):
        return v / Decimal("12.92")
    return Decimal(((v + Decimal("0.055")) / Decimal("1.055")) ** Decimal("2.4"))


TONES: dict[str, Callable[[Decimal], Decimal]] = {"smoothstep": smoothstep_inverse, "none": lambda x: x}


def exact_curve(tone: str, gamma: str, code: int, codes: int) -> Decimal:
    """Return entry ``code`` of the curve to `DIGITS` digits."""
    with localcontext() as context:
        context.prec = DIGITS
        v = TONES[tone](Decimal(code) / (codes - 1))
        if gamma == "srgb":
            return srgb_expand(v)
        return v ** Decimal(gamma) if v else v


@functools.lru_cache(maxsize=8)
def _linear_table(tone: str, gamma: str, codes: int) -> Float:
    if codes <= 256:
        return _frozen(_build(tone, gamma, codes), PINNED.get((tone, gamma, codes)))
    return _cached(tone, gamma, codes)


def _build(tone: str, gamma: str, codes: int) -> Float:
    return np.array([float(exact_curve(tone, gamma, code, codes)) for code in range(codes)])


def _cached(tone: str, gamma: str, codes: int) -> Float:
    expected = PINNED.get((tone, gamma, codes))
    path = cache_folder() / f"curve-{tone}-{gamma}-{codes}.bin"
    table = _read(path, codes, expected)
    if table is None:
        table = _build_and_keep(path, tone, gamma, codes, expected)
    return _frozen(table, expected)


def _build_and_keep(path: Path, tone: str, gamma: str, codes: int, expected: str | None) -> Float:
    """Build the curve, or wait for whoever is building it; without a place to keep it, every process pays."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(path.with_suffix(".lock")):
            table = _read(path, codes, expected)
            if table is None:
                table = _build(tone, gamma, codes)
                _write(path, table)
            return table
    except OSError:
        return _build(tone, gamma, codes)


def cache_folder() -> Path:
    """Return where big tables are kept: ``$XDG_CACHE_HOME/unprocess_gen``, by default below ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "unprocess_gen"


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def _read(path: Path, codes: int, expected: str | None) -> Float | None:
    """Return a kept curve; None where there is none, or one that is damaged or not the pinned one."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    payload, digest = content[:-32], content[-32:]
    found = hashlib.sha256(payload)
    if len(payload) != 8 * codes or found.digest() != digest or expected not in (None, found.hexdigest()):
        return None
    return np.frombuffer(payload, dtype="<f8").astype(np.float64)


def _write(path: Path, table: Float) -> None:
    payload = table.astype("<f8").tobytes()
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as handle:
        try:
            handle.write(payload + hashlib.sha256(payload).digest())
            handle.flush()
            os.replace(handle.name, path)
        except OSError:
            Path(handle.name).unlink()
            raise


def sha256(table: Float) -> str:
    """Return the SHA-256 of a table's little-endian doubles."""
    return hashlib.sha256(table.astype("<f8").tobytes()).hexdigest()


def _frozen(table: Float, expected: str | None) -> Float:
    if expected is not None and (found := sha256(table)) != expected:
        raise MachineError(f"a table came out as {found}, expected {expected}: this Python computes differently")
    table.flags.writeable = False
    return table


# ----------------------------------------------------------------------------------------------- inverse-CDF tables


def normal_quantile(p: Decimal) -> Decimal:
    """Return Phi^-1(p) for p in [2**-53, 1 - 2**-53], with 23 digits or more; Newton on `normal_cdf`."""
    with localcontext() as context:
        context.prec = DIGITS
        z = Decimal(NormalDist().inv_cdf(float(p)))
        for _ in range(2):
            z -= (normal_cdf(z) - p) / normal_density(z)
        return z


def normal_density(z: Decimal) -> Decimal:
    """Return the standard normal density at z, in the precision of the current decimal context."""
    return (-z * z / 2).exp() / (2 * PI).sqrt()


def normal_cdf(z: Decimal) -> Decimal:
    """Return Phi(z) = ½ + phi(z)·(z + z³/3 + z⁵/15 + …) (Abramowitz and Stegun 26.2.11), |z| up to 8."""
    term = total = z
    k = 1
    while abs(term) > Decimal(10) ** -(DIGITS + 2):
        k += 2
        term = term * z * z / k
        total += term
    return Decimal("0.5") + normal_density(z) * total


PI = Decimal("3.14159265358979323846264338327950288419716939937510582")

# Steps of the grids that the three coefficients are rounded to: fine enough to cost under 1e-9, coarse enough that a
# libm a few units off in the last place still gives the same table (the test measures the distance to a rounding edge).
COEFFICIENT_GRID = (2.0**-36, 2.0**-28, 2.0**-20)
NODES = (0.5 - math.sqrt(3) / 4, 0.5, 0.5 + math.sqrt(3) / 4)
"""Chebyshev's nodes of a segment: the quadratic through them has nearly the least possible error."""


@functools.lru_cache(maxsize=64)
def tukey_table(shape: float) -> Float:
    """Return the quadratics of Tukey's lambda distribution with variance 1, float64 ``[1024, 3]`` as `normal_table`.

    Its quantile function is ((1 - p)**shape - p**shape) / shape for the tail probability p, ln((1 - p) / p) for shape 0
    (the logistic law); the variance is finite for a shape above -1/2, and ValueError is raised for others. Computed in
    `decimal`, so that any shape gives the same table everywhere; 0.2 s.
    """
    if not -0.5 < shape < 10:
        raise ValueError(f"the shape is {shape}, expected a number above -0.5, and below 10")
    rows = []
    with localcontext() as context:
        context.prec = DIGITS
        std = tukey_std(shape)
        for octave in range(OCTAVES):
            for segment in range(SEGMENTS):
                nodes = (1 + (segment + Decimal(node)) / SEGMENTS for node in NODES)
                tails = (node * Decimal(2) ** (octave - 33) for node in nodes)
                rows.append(_through([float(tukey_quantile(tail, shape) / std) for tail in tails]))
    table = np.array(rows)
    table.flags.writeable = False
    return table


def tukey_quantile(tail: Decimal, shape: float) -> Decimal:
    """Return how far out a tail probability lies, in units of the scale, in the current decimal context."""
    if abs(shape) < LOGISTIC:
        return ((1 - tail) / tail).ln()
    power = Decimal(shape)
    return ((power * (1 - tail).ln()).exp() - (power * tail.ln()).exp()) / power


def tukey_std(shape: float) -> Decimal:
    """Return the standard deviation of Tukey's lambda distribution of scale 1, in the current decimal context.

    √(2 / λ² · (1 / (1 + 2λ) - Γ(λ + 1)² / Γ(2λ + 2))), π / √3 at 0 (Joiner and Rosenblatt, JASA 1971).
    """
    if abs(shape) < LOGISTIC:
        return PI / Decimal(3).sqrt()
    power = Decimal(shape)
    beta = (2 * _log_gamma(power + 1) - _log_gamma(2 * power + 2)).exp()
    return (2 / power**2 * (1 / (1 + 2 * power) - beta)).sqrt()


LOGISTIC = 1e-12
"""A shape this near 0 is taken for 0: the laws differ by less than a double can tell."""

_BERNOULLI = ((1, 6), (-1, 30), (1, 42), (-1, 30), (5, 66), (-691, 2730), (7, 6), (-3617, 510), (43867, 798))
_SHIFT = 60


def _log_gamma(x: Decimal) -> Decimal:
    """Return ln Γ(x), x > 0, by Stirling's series at x + 60, whose ninth term is below 1e-30."""
    product = Decimal(1)
    for step in range(_SHIFT):
        product *= x + step
    far = x + _SHIFT
    series = (far - Decimal("0.5")) * far.ln() - far + (2 * PI).ln() / 2
    for n, (top, bottom) in enumerate(_BERNOULLI, start=1):
        series += Decimal(top) / bottom / (2 * n * (2 * n - 1)) / far ** (2 * n - 1)
    return series - product.ln()


@functools.lru_cache(maxsize=1)
def exponential_levels() -> Float:
    """Return 1024 equally likely values of an exponential law of mean 1, float64 ``[1024]``, rising.

    The logarithms at the middles of equal probabilities, divided by their mean.
    """
    with localcontext() as context:
        context.prec = DIGITS
        levels = [-((1023 - step + Decimal("0.5")) / 1024).ln() for step in range(1024)]
        mean = sum(levels, Decimal(0)) / 1024
        table = np.array([float(level / mean) for level in levels])
    table.flags.writeable = False
    return table


@functools.lru_cache(maxsize=1)
def _normal_table() -> Float:
    rows = [_quadratic(octave, segment) for octave in range(OCTAVES) for segment in range(SEGMENTS)]
    grid = np.array(COEFFICIENT_GRID)
    return _frozen(np.rint(np.array(rows) / grid) * grid, NORMAL_SHA256)


def _quadratic(octave: int, segment: int) -> tuple[float, float, float]:
    quantile = NormalDist().inv_cdf
    z = [-quantile(math.ldexp(1 + segment / SEGMENTS + node / SEGMENTS, octave - 33)) for node in NODES]
    return _through(z)


def _through(z: Sequence[float]) -> tuple[float, float, float]:
    """Return the quadratic in the position within a segment that has the values z at `NODES`."""
    t = [node / SEGMENTS for node in NODES]
    slope01, slope12 = (z[1] - z[0]) / (t[1] - t[0]), (z[2] - z[1]) / (t[2] - t[1])
    c2 = (slope12 - slope01) / (t[2] - t[0])
    c1 = slope01 - c2 * (t[0] + t[1])
    return z[0] - t[0] * (c1 + t[0] * c2), c1, c2
