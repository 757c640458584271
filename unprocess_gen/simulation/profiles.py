"""Colour profiles of photographs: exact tables from codes to light in the picture's own primaries, and their matrix.

A code is linearised by the profile's curve, encoded by that of sRGB, and then treated as an sRGB code: tone curve and
gamma are inverted. So with ``isp=srgb``, the table is the profile's curve. The matrix to linear sRGB is merged with the
matrix of the camera (`reference.colour.from_primaries`); colours outside sRGB stay negative until then.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from decimal import Decimal, localcontext
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.simulation.lookup_tables import freeze
from unprocess_gen.simulation.tone_curves import exact_light, gamma_text, linear_table, power, srgb_compress

SRGB = "sRGB"
"""Name in rows of photographs without a profile, or whose profile moves no colour by more than two 8-bit codes."""

Curve = tuple[float, ...] | bytes
"""Curve from value to light: (g, a, b, c, d, e, f) of (a·x + b)^g + e from x = d on, and c·x + f below it (ICC.1,
parametricCurveType 4); or equally spaced values of 16 bits, big-endian, between which light is linear."""

Curves = tuple[Curve | None, Curve | None, Curve | None]
"""Curves of red, green and blue; None is the curve of sRGB."""

NO_LIGHT = Decimal("1e-30")
"""Light up to which curves are black; floats hold the root of it."""

PROFILE_DIGITS = 25
"""Decimal digits in which light is computed; it is rounded once to float64."""


class Profile(NamedTuple):
    """Colours of a photograph: ``to_srgb`` is the matrix to linear sRGB, None for photographs that are read as sRGB.

    Rows record only the name; the file of the source has the numbers. Without a name, colours were not converted.
    """

    name: str = ""
    to_srgb: tuple[float, ...] | None = None
    curves: Curves = (None, None, None)

    @property
    def is_srgb(self) -> bool:
        """True if codes are in sRGB; ValueError for a profile from a row, of which only the name is known."""
        if self.to_srgb is None and self.name not in ("", SRGB):
            raise ValueError(f"profile={self.name!r}: only its name is known; expected the profile of the source")
        return self.to_srgb is None


UNCONVERTED = Profile()
"""Profile of synthetic pictures and arrays, of raw frames, and of photographs with ``source.icc=ignore``."""


def light_tables(profile: Profile, tone: str, gamma: float | str, codes: int) -> tuple[Float, Float, Float]:
    """Tables from code to light of red, green and blue, float64 [codes] each; arguments as of `linear_table`."""
    srgb = linear_table(tone, gamma, codes)
    if profile.is_srgb:
        return srgb, srgb, srgb
    red, green, blue = (
        srgb if curve is None else _table(curve, tone, gamma_text(gamma), codes) for curve in profile.curves
    )
    return red, green, blue


@functools.lru_cache(maxsize=16)
def _table(curve: Curve, tone: str, gamma: str, codes: int) -> Float:
    """Table of a curve. It takes 20 ms for 256 codes, 4 s for 65,536, once in each process."""
    with localcontext(prec=PROFILE_DIGITS):
        is_light = (tone, gamma) == ("none", "srgb")
        light = curve_light(curve, range(codes), codes)
        return freeze(np.array([float(y if is_light else exact_light(tone, gamma, srgb_compress(y))) for y in light]))


def curve_light(curve: Curve, chosen: Iterable[int], codes: int) -> list[Decimal]:
    """Light of the chosen codes by a curve, divided by the light of white; ValueError if that is not nearly 1."""
    with localcontext(prec=PROFILE_DIGITS):
        white = _light(curve, codes - 1, codes)
        if abs(white - 1) > Decimal("0.02"):
            raise ValueError("a curve does not rise from black to white")
        light = (_light(curve, code, codes) / white for code in chosen)
        return [min(y, Decimal(1)) if y > NO_LIGHT else Decimal(0) for y in light]


def _light(curve: Curve, code: int, codes: int) -> Decimal:
    """Light of a code by a curve, in the current decimal context."""
    if not isinstance(curve, bytes):
        g, a, b, c, d, e, f = map(Decimal, curve)
        x = Decimal(code) / (codes - 1)
        return power(max(a * x + b, Decimal(0)), g) + e if x >= d else c * x + f
    last = len(curve) // 2 - 1
    index, rest = divmod(code * last, codes - 1)
    low, high = (int.from_bytes(curve[2 * n : 2 * n + 2]) for n in (index, min(index + 1, last)))
    return Decimal(low * (codes - 1 - rest) + high * rest) / (65535 * (codes - 1))
