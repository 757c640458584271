"""Tables that convert codes to linear light: exact inverse tone curve and gamma expansion.

Curves are computed in `decimal` with 40 digits and rounded once to float64, because powers in NumPy and libm differ
between machines. Each entry is correctly rounded. A curve of 256 codes takes 30 ms. A curve of 65,536 codes takes 7 s
or more, so the curves of the options in ``conf/isp`` are package data. For another ``isp.gamma``, each process that
decodes 16-bit sources computes the curve once. The SHA-256 of the package data and of the default curves is checked.

``python -m unprocess_gen.simulation.tone_curves`` regenerates the package data (30 s).
"""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Callable
from decimal import Decimal, getcontext, localcontext
from pathlib import Path

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.exact_distributions import DIGITS
from unprocess_gen.simulation.lookup_tables import freeze

PUBLISHED_SHA256 = {
    ("smoothstep", "2.2", 256): "d358dd03d38f763306ef83a982403114f2ff8e5397025f2c68dbe50e85503bfa",
    ("none", "2.2", 256): "d88862390e829fe50b30dad857e46bd483eba84df9360b31afd364070f23c73e",
    ("none", "srgb", 256): "50108edde31f5f4cb0697f42d7366a51efd4f0070109b257bf9132bf7293e2b4",
    ("none", "1", 256): "9eb7f1f01b639e68e5f9e5442b3512c457995d4a9a0f7911e541cd839b4ba055",
    ("smoothstep", "2.2", 65536): "0b4e6586b50ad74765f96580bfab938e3a533bc9483241cc642157054464c4af",
    ("none", "2.2", 65536): "9d8cd64fbd28b487e83708a1bf998cb59dcca50b531d72fb42987f2a1d2e2697",
    ("none", "srgb", 65536): "16e1d9575cec5ce1ebb97a0fe9866cf5d2c434696708e32ffa0364d683e116ed",
    ("none", "1", 65536): "71a3e67f3353f4a46ab0945c29cfcc7a0755e61bdee98cde71aa2a85f4681341",
}
"""SHA-256 of the float64 values of each curve that ``conf/isp`` offers, by tone, gamma and number of codes."""

STORED_CURVES = Path(__file__).parent / "data" / "curves_16bit.npz"
"""The curves of 65,536 codes in `PUBLISHED_SHA256`, as differences of order `DIFFERENCES` of the float64 bits."""

DIFFERENCES = 4
"""Order of the stored differences. Neighbouring entries differ smoothly, so 512 kB per curve become 40 kB."""


def gamma_text(gamma: float | str) -> str:
    """Text of a gamma in the manifest: ``srgb``, or the shortest decimal number, such as ``1`` or ``2.2``."""
    if gamma == "srgb":
        return "srgb"
    number = float(gamma)
    return str(int(number)) if number.is_integer() else repr(number)


@functools.lru_cache(maxsize=8)
def linear_table(tone: str, gamma: float | str, codes: int) -> Float:
    """Curve from code to linear light: float64 [codes], from 0 to 1, correctly rounded, read-only.

    ``tone`` is ``smoothstep`` (3x² - 2x³) or ``none``, ``gamma`` an exponent or ``srgb`` (IEC 61966-2-1), ``codes`` 256
    or 65,536. Raises ValueError for an unknown tone, MachineError if a published curve differs or the package data is
    missing.
    """
    if tone not in EXACT_INVERSE_TONES:
        raise ValueError(f"tone={tone}: unknown tone curve; expected one of {', '.join(EXACT_INVERSE_TONES)}")
    text = gamma_text(gamma)
    published = PUBLISHED_SHA256.get((tone, text, codes))
    is_stored = published is not None and codes == 65536
    table = _read_stored(tone, text) if is_stored else compute_curve(tone, text, codes)
    return freeze(table, published)


def smoothstep_inverse(x: Decimal) -> Decimal:
    """The y in [0, 1] with 3y² - 2y³ = x, for x in [0, 1], by Newton's method."""
    if x > Decimal("0.5"):
        return 1 - smoothstep_inverse(1 - x)
    if x == 0:
        return x
    y = Decimal(2 * math.sin(math.asin(math.sqrt(x)) / 3) * math.cos(math.pi / 6 - math.asin(math.sqrt(x)) / 3))
    for _ in range(3):
        y -= (y * y * (3 - 2 * y) - x) / (6 * y * (1 - y))
    return y


def srgb_expand(v: Decimal) -> Decimal:
    """Linear light of an sRGB value in [0, 1] (IEC 61966-2-1)."""
    if v <= SRGB_TOE:
        return v / Decimal("12.92")
    return power((v + Decimal("0.055")) / Decimal("1.055"), Decimal("2.4"))


def srgb_compress(light: Decimal) -> Decimal:
    """sRGB value of linear light in [0, 1], the inverse of `srgb_expand`."""
    if light <= SRGB_TOE / Decimal("12.92"):
        return light * Decimal("12.92")
    return Decimal("1.055") * power(light, 1 / Decimal("2.4")) - Decimal("0.055")


SRGB_TOE = Decimal("0.04045")
"""sRGB value up to which light is proportional to it (IEC 61966-2-1)."""


def power(base: Decimal, exponent: Decimal) -> Decimal:
    """Power of a number that is not negative, in a quarter of the time of ``**``.

    The logarithm of x is the cached logarithm of a nearby float c plus the series 2·artanh((x - c) / (x + c)). With
    |x/c - 1| < 2**-6, each term is smaller than the last by 2**-14.
    """
    if not base:
        return base
    fraction, octave = math.frexp(base)
    near = math.ldexp(int(fraction * 128), octave - 7)
    centre = Decimal(near)
    term = series = (base - centre) / (base + centre)
    square = series * series
    for odd in range(3, getcontext().prec // 2, 2):
        term *= square
        series += term / odd
    return (exponent * (_ln(near) + 2 * series)).exp()


@functools.cache
def _ln(x: float) -> Decimal:
    with localcontext(prec=DIGITS + 5):
        return Decimal(x).ln()


EXACT_INVERSE_TONES: dict[str, Callable[[Decimal], Decimal]] = {"smoothstep": smoothstep_inverse, "none": lambda x: x}


def exact_curve(tone: str, gamma: str, code: int, codes: int) -> Decimal:
    """Linear light of one code to `DIGITS` digits; ``gamma`` is spelled as by `gamma_text`."""
    with localcontext(prec=DIGITS):
        return exact_light(tone, gamma, Decimal(code) / (codes - 1))


def exact_light(tone: str, gamma: str, value: Decimal) -> Decimal:
    """Linear light of a displayed value in [0, 1], in the current decimal context."""
    value = EXACT_INVERSE_TONES[tone](value)
    return srgb_expand(value) if gamma == "srgb" else power(value, Decimal(gamma))


def compute_curve(tone: str, gamma: str, codes: int) -> Float:
    """Compute a curve in `decimal`, float64 [codes]."""
    return np.array([float(exact_curve(tone, gamma, code, codes)) for code in range(codes)])


def _read_stored(tone: str, gamma: str) -> Float:
    """Read a curve of 65,536 codes from the package data, float64 [65536]."""
    try:
        with np.load(io.BytesIO(STORED_CURVES.read_bytes()), allow_pickle=False) as stored:
            bits = stored[f"{tone}-{gamma}"]
    except Exception as error:  # a damaged archive raises various types
        raise MachineError(f"{STORED_CURVES}: cannot be read ({error}); reinstall unprocess_gen") from error
    for _ in range(DIFFERENCES):
        bits = np.cumsum(bits, dtype=np.int64)
    return np.asarray(bits.view(np.float64))


def store_curves(path: Path) -> None:
    """Compute all published curves of 65,536 codes and write them to ``path``."""
    stored = {}
    for (tone, gamma, codes), published in PUBLISHED_SHA256.items():
        if codes == 65536:
            bits = freeze(compute_curve(tone, gamma, codes), published).view(np.int64)
            stored[f"{tone}-{gamma}"] = np.diff(bits, n=DIFFERENCES, prepend=np.zeros(DIFFERENCES, dtype=np.int64))
    np.savez_compressed(path, allow_pickle=False, **stored)


if __name__ == "__main__":
    store_curves(STORED_CURVES)
