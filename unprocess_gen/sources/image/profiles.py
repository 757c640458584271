"""Read the colours that a photograph declares: ICC profiles of matrix and curves, code points (H.273), gAMA and cHRM.

Numbers of files are exact; the matrix to linear sRGB is computed in fractions. A profile that moves no colour by more
than two codes counts as sRGB, because profiles of sRGB differ in their last digits. See ``docs/design/decoding.md``.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.errors import SourceError
from unprocess_gen.simulation.profiles import SRGB, Curve, Profile, curve_light
from unprocess_gen.simulation.reference.primaries import PRIMARIES, primaries2xyz, xyz2srgb
from unprocess_gen.simulation.tone_curves import linear_table
from unprocess_gen.sources.image.headers import Header

SRGB_TOLERANCE = 2
"""Largest difference, in 8-bit codes, between a profile and sRGB that still counts as sRGB; real ones differ by 1."""

CURVE_TOLERANCE = 6
"""Largest difference from the curve of sRGB, in 16-bit codes, that counts as rounding of a curve's parameters."""

WHITE_TOLERANCE = 0.02
"""Largest difference from 1 of each channel of white in linear sRGB: two codes."""


def profile_of(header: Header) -> Profile:
    """Profile of a photograph by cICP, else ICC, else gAMA and cHRM; SourceError ``icc`` if it cannot be used."""
    try:
        if header.cicp is not None:
            return _of_code_points(*header.cicp[:2])
        return _of_icc(header.icc) if header.icc else _of_png(header.gamma, header.chromaticities)
    except (ValueError, LookupError, ArithmeticError, struct.error) as error:
        problem: object = error  # the words of others differ between versions
        if not isinstance(error, ValueError):
            problem = "it lacks values that it declares"
        text = f"the colour profile cannot be used: {problem}; convert the picture to sRGB, or set source.icc=ignore"
        raise SourceError("icc", text) from None


def _profile(name: str, colorants: Sequence[Fraction], curves: Sequence[Curve | None]) -> Profile:
    """Profile from colorants (XYZ under D50) and the curves of R, G and B; that of sRGB if it hardly moves colours.

    Every third gray and 216 colours are compared.
    """
    to_srgb, grays = xyz2srgb(colorants), np.arange(0, 256, 3)
    lights = [_rising(curve, grays) for curve in curves]
    kept = [
        None if np.abs(_codes(light) - 257 * grays).max() <= CURVE_TOLERANCE else curve
        for curve, light in zip(curves, lights, strict=True)
    ]
    numbers = np.concatenate([np.indices((6, 6, 6)).reshape(3, -1) * 17, np.tile(np.arange(grays.size), (3, 1))], 1)
    red, green, blue = (light[number] for light, number in zip(lights, numbers, strict=True))
    rows = zip(to_srgb[::3], to_srgb[1::3], to_srgb[2::3], strict=True)
    light = np.stack([(r * red + g * green) + b * blue for r, g, b in rows])
    if np.abs(light[:, -1] - 1).max() > WHITE_TOLERANCE:
        raise ValueError("its primaries do not add up to white")
    if np.abs(np.rint(_codes(light) / 257) - grays[numbers]).max() <= SRGB_TOLERANCE:
        return Profile(SRGB)
    name = re.sub("[^ -~]", "?", name).strip(" =+-@")[:60] or "unnamed"
    return Profile(f"not {SRGB}" if name == SRGB else name, to_srgb, (kept[0], kept[1], kept[2]))


def _rising(curve: Curve | None, grays: NDArray[np.int64]) -> Float:
    """Light of gray codes; ValueError unless the curve rises from black to white."""
    if curve is None:
        return linear_table("none", "srgb", 256)[grays]
    light = np.array([*map(float, curve_light(curve, grays.tolist(), 256))])
    if light[0] > 0.1 or (np.diff(light) < 0).any():
        raise ValueError("a curve does not rise from black to white")
    return light


def _codes(light: Float) -> NDArray[np.int64]:
    """16-bit codes of light in sRGB, without a power."""
    return np.searchsorted(linear_table("none", "srgb", 65536), np.clip(light, 0, 1))


def _gamma(exponent: float) -> Curve:
    return exponent, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0


# ------------------------------------------------------------------------------------------------ code points, and PNG

_PRIMARIES = {1: "srgb", 2: "srgb", 9: "rec2020", 12: "p3"}
"""Primaries by code point (H.273, table 2); 2 is unspecified, which is read as sRGB."""

_BT709: Curve = (1 / 0.45, 1 / 1.099, 0.099 / 1.099, 1 / 4.5, 0.081, 0.0, 0.0)
_TRANSFERS = {**dict.fromkeys((1, 6, 14, 15), _BT709), 4: _gamma(2.2), 5: _gamma(2.8), 2: None, 13: None}
"""Curves by code point (H.273, table 3)."""


@lru_cache(maxsize=32)
def _of_code_points(primaries: int, transfer: int) -> Profile:
    if primaries not in _PRIMARIES or transfer not in _TRANSFERS:
        raise ValueError(f"primaries {primaries} and transfer {transfer} (H.273) are not known")
    colorants = primaries2xyz(PRIMARIES[_PRIMARIES[primaries]])
    return _profile(f"cICP {primaries}/{transfer}", colorants, (_TRANSFERS[transfer],) * 3)


SRGB_GAMMA = 45455
"""The gAMA of pictures in sRGB (PNG, 11.3.2.4)."""


@lru_cache(maxsize=32)
def _of_png(gamma: bytes, chromaticities: bytes) -> Profile:
    """Profile of gAMA and cHRM (white, R, G, B), both in units of 1e-5; what is missing is as in sRGB."""
    curve, xy, name = None, PRIMARIES["srgb"], ""
    if gamma and (number := int.from_bytes(gamma)) != SRGB_GAMMA:
        curve, name = _gamma(100000 / number), f"gAMA {number / 100000:g}"
    if chromaticities:
        white_x, white_y, *rgb = (n / 100000 for n in struct.unpack(">8I", chromaticities))
        xy, name = (*rgb, white_x, white_y), f"{name} cHRM"
    return _profile(name, primaries2xyz(xy), (curve,) * 3)


# ----------------------------------------------------------------------------------------------------------------- ICC

_MOST_TAGS, _MOST_VALUES = 100, 65536
_CHANNELS = {(b"RGB ", b"XYZ "): b"rgb", (b"GRAY", b"XYZ "): b"kkk"}
"""First letters of the tags of curves, by colour space and connection space."""

_PARAMETRIC: dict[int, tuple[int, Callable[..., Curve]]] = {
    0: (1, _gamma),
    1: (3, lambda g, a, b: (g, a, b, 0.0, -b / a, 0.0, 0.0)),
    2: (4, lambda g, a, b, c: (g, a, b, 0.0, -b / a, c, c)),
    3: (5, lambda g, a, b, c, d: (g, a, b, c, d, 0.0, 0.0)),
    4: (7, lambda *parameters: parameters),
}
"""Number of parameters of each type of parametric curve, and the curve (ICC.1, 10.18)."""


@lru_cache(maxsize=32)
def _of_icc(data: bytes) -> Profile:
    size, count = *struct.unpack_from(">I", data), *struct.unpack_from(">I", data, 128)
    if data[36:40] != b"acsp" or size > len(data) or count > _MOST_TAGS:
        raise ValueError(f"its {len(data)} bytes are not those of an ICC profile of {size} bytes with {count} tags")
    places = [struct.unpack_from(">4sII", data, 132 + 12 * n) for n in range(count)]
    tags = {name: memoryview(data)[offset : offset + length] for name, offset, length in reversed(places)}
    spaces, colorants = (data[16:20], data[20:24]), primaries2xyz(PRIMARIES["srgb"])
    if tables := [name.decode("latin-1") for name in tags if name[:3] in (b"A2B", b"D2B")]:
        raise ValueError(f"it converts by tables ({tables[0]}), not by a matrix and curves")
    if spaces not in _CHANNELS:
        raise ValueError(f"it converts {spaces[0]!r} to {spaces[1]!r}; expected RGB or GRAY to XYZ")
    curves = [_curve(tags[b"%cTRC" % channel]) for channel in _CHANNELS[spaces]]
    if spaces[0] == b"RGB ":
        columns = [struct.unpack_from(">3i", tags[b"%cXYZ" % channel], 8) for channel in b"rgb"]
        colorants = [Fraction(column[row], 65536) for row in range(3) for column in columns]
    return _profile(_description(bytes(tags.get(b"desc", b""))), colorants, curves)


def _curve(tag: memoryview) -> Curve:
    """Curve of a tag ``curv`` or ``para``."""
    kind, (count,) = bytes(tag[:4]), struct.unpack_from(">I", tag, 8)
    if kind == b"curv" and count <= _MOST_VALUES:
        values = struct.unpack_from(f">{count}H", tag, 12)
        return bytes(tag[12 : 12 + 2 * count]) if count > 1 else _gamma(values[0] / 256 if values else 1.0)
    if kind != b"para":
        raise ValueError(f"a curve is of type {kind!r} with {count} values")
    length, curve_of = _PARAMETRIC[count >> 16]
    g, *others = (number / 65536 for number in struct.unpack_from(f">{length}i", tag, 12))
    if g <= 0:
        raise ValueError("a curve does not rise from black to white")
    return curve_of(g, *others)


def _description(tag: bytes) -> str:
    """Name of a profile, in its first language."""
    if tag.startswith(b"mluc"):
        length, offset = struct.unpack_from(">II", tag, 20)
        return tag[offset : offset + length].decode("utf-16-be", "replace")
    return tag[12:].partition(b"\0")[0].decode("latin-1")
