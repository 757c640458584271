"""Read the colours that a photograph declares: ICC profiles of matrix and curves, code points (H.273), gAMA and cHRM.

Numbers of files are exact, and the matrix to linear sRGB follows in fractions. A profile that moves no colour by more
than two codes is sRGB: those of sRGB differ in their last digits. Refusals: ``docs/design/decoding.md``.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from fractions import Fraction
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.errors import SourceError
from unprocess_gen.simulation.profiles import SRGB, Curve, Profile, curve_light, white_light
from unprocess_gen.simulation.reference.primaries import PRIMARIES, Exact, primaries2xyz, xyz2srgb
from unprocess_gen.simulation.tone_curves import linear_table
from unprocess_gen.sources.image.headers import Header

SRGB_PROFILE = Profile(SRGB)

SRGB_TOLERANCE = 2
"""Largest difference, in 8-bit codes, between a profile and sRGB that still counts as sRGB; real ones differ by 1."""

CURVE_TOLERANCE = 6
"""Largest difference, in 16-bit codes, between a curve and that of sRGB which rounded parameters of it can have."""

WHITE_TOLERANCE = 0.02
"""Largest difference from 1 of the light at white: two codes."""


def profile_of(header: Header) -> Profile:
    """Profile of a photograph by cICP, else ICC, else gAMA and cHRM; SourceError ``icc`` if it cannot be used."""
    try:
        if header.cicp is not None:
            return _of_code_points(*header.cicp[:2])
        if header.icc:
            return _of_icc(header.icc, header.is_gray)
        if header.gamma or header.chromaticities:
            return _of_png(header.gamma, header.chromaticities)
        return SRGB_PROFILE
    except (ValueError, struct.error) as error:
        problem = "it ends too early" if isinstance(error, struct.error) else error
        text = f"the colour profile cannot be used: {problem}; convert the picture to sRGB, or set source.icc=ignore"
        raise SourceError("icc", text) from None


def _profile(name: str, colorants: Sequence[Fraction], curves: Sequence[Curve | None]) -> Profile:
    """Profile with these columns of XYZ under D50 and these curves, or `SRGB_PROFILE` if it hardly moves colours."""
    to_srgb = np.reshape(xyz2srgb(colorants), (3, 3))
    grays = np.arange(0, 256, 3)
    lights = np.array([linear_table("none", "srgb", 256)[grays] if c is None else _rising(c, grays) for c in curves])
    is_srgb = [np.abs(_codes(light) - 257 * grays).max() <= CURVE_TOLERANCE for light in lights]
    colours = np.concatenate(
        [np.indices((6, 6, 6)).reshape(3, -1) * 17, np.tile(np.arange(grays.size), (3, 1))], axis=1
    )
    red, green, blue = (light[number] for light, number in zip(lights, colours, strict=True))
    light = np.stack([(row[0] * red + row[1] * green) + row[2] * blue for row in to_srgb])
    if np.abs(light[:, -1] - 1).max() > WHITE_TOLERANCE:
        raise ValueError("the sum of its primaries is not white")
    if np.abs(np.rint(_codes(light) / 257) - grays[colours]).max() <= SRGB_TOLERANCE:
        return SRGB_PROFILE
    name = re.sub("[^ -~]", "?", name).strip(" =+-@")[:60] or "unnamed"
    red_curve, green_curve, blue_curve = (None if same else curve for same, curve in zip(is_srgb, curves, strict=True))
    return Profile(f"not {SRGB}" if name == SRGB else name, xyz2srgb(colorants), (red_curve, green_curve, blue_curve))


def _rising(curve: Curve, grays: NDArray[np.int64]) -> Float:
    """Light of gray codes; ValueError unless the curve rises from black to white."""
    if abs(white_light(curve) - 1) <= WHITE_TOLERANCE:
        light = np.array([*map(float, curve_light(curve, grays.tolist(), 256))])
        if light[0] < 0.1 and (np.diff(light) >= 0).all():
            return light
    raise ValueError("a curve does not rise from black to white")


def _codes(light: Float) -> NDArray[np.int64]:
    """Nearest 16-bit codes of sRGB, without a power."""
    return np.searchsorted(_between_codes(), np.clip(light, 0, 1))


@cache
def _between_codes() -> Float:
    table = linear_table("none", "srgb", 65536)
    return (table[1:] + table[:-1]) / 2


def _gamma(exponent: float) -> Curve:
    return exponent, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0


@cache
def _srgb_colorants() -> Exact:
    return primaries2xyz(PRIMARIES["srgb"])


# ----------------------------------------------------------------------------------------------- code points, and PNG

_P3, _BT601 = PRIMARIES["p3"], (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, 0.3127, 0.3290)
_PRIMARIES = {
    **dict.fromkeys((1, 2), PRIMARIES["srgb"]),
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, 0.3127, 0.3290),
    **dict.fromkeys((6, 7), _BT601),
    9: PRIMARIES["rec2020"],
    11: (*_P3[:6], 0.314, 0.351),
    12: _P3,
}
"""Chromaticities by code point (H.273, table 2); 2 is unspecified, which is read as sRGB."""

_BT709: Curve = (1 / 0.45, 1 / 1.099, 0.099 / 1.099, 1 / 4.5, 0.081, 0.0, 0.0)
_TRANSFERS = {**dict.fromkeys((1, 6, 14, 15), _BT709), 4: _gamma(2.2), 5: _gamma(2.8), 2: None, 13: None}
"""Curves by code point (H.273, table 3)."""


@cache
def _of_code_points(primaries: int, transfer: int) -> Profile:
    if primaries not in _PRIMARIES or transfer not in _TRANSFERS:
        raise ValueError(f"its code points {primaries} (primaries) and {transfer} (transfer) are not known")
    curve = _TRANSFERS[transfer]
    return _profile(f"cICP {primaries}/{transfer}", primaries2xyz(_PRIMARIES[primaries]), (curve,) * 3)


SRGB_GAMMA = 45455
"""The gAMA of pictures in sRGB (PNG, 11.3.2.4)."""


@lru_cache(maxsize=32)
def _of_png(gamma: bytes, chromaticities: bytes) -> Profile:
    """Profile of gAMA and cHRM (white, R, G, B), both in units of 1e-5; what is missing is as in sRGB."""
    curve, colorants, name = None, _srgb_colorants(), ""
    if gamma and (number := int.from_bytes(gamma)) != SRGB_GAMMA:
        curve, name = _gamma(100000 / max(number, 1)), f"gAMA {number / 100000:g}"
    if chromaticities:
        white_x, white_y, *rgb = (Fraction(n, 100000) for n in struct.unpack(">8I", chromaticities))
        colorants, name = primaries2xyz((*rgb, white_x, white_y)), f"{name} cHRM"
    return _profile(name, colorants, (curve,) * 3)


# ----------------------------------------------------------------------------------------------------------------- ICC

_MOST_TAGS, _MOST_VALUES = 100, 65536
_TABLES = *(b"A2B%d" % n for n in range(3)), *(b"D2B%d" % n for n in range(4))
_CHANNELS = {b"RGB ": b"rgb", b"GRAY": b"kkk"}


@lru_cache(maxsize=32)
def _of_icc(data: bytes, is_gray: bool) -> Profile:
    tags, space = _tags(data), data[16:20]
    if tables := [tag.decode() for tag in _TABLES if tag in tags]:
        raise ValueError(f"it converts by tables ({', '.join(tables)}), not by matrix and curves")
    if space not in _CHANNELS or data[20:24] != b"XYZ " or (space == b"GRAY" and not is_gray):
        raise ValueError(f"it converts {space.decode('latin-1')!a} to {data[20:24].decode('latin-1')!a}")
    curves = [_curve(_tag(tags, b"%cTRC" % channel)) for channel in _CHANNELS[space]]
    if space == b"GRAY":
        return _profile(_description(tags), _srgb_colorants(), curves)
    columns = [struct.unpack_from(">3i", _tag(tags, b"%cXYZ" % channel), 8) for channel in b"rgb"]
    colorants = [Fraction(column[row], 65536) for row in range(3) for column in columns]
    return _profile(_description(tags), colorants, curves)


def _tags(data: bytes) -> dict[bytes, memoryview]:
    """Tags of a profile, which may share bytes."""
    if data[36:40] != b"acsp":
        raise ValueError("it is no ICC profile")
    size, count = *struct.unpack_from(">I", data), *struct.unpack_from(">I", data, 128)
    if size > len(data) or count > _MOST_TAGS:
        raise ValueError(f"it declares {size} bytes and {count} tags, and has {len(data)} bytes")
    places = [struct.unpack_from(">4sII", data, 132 + 12 * n) for n in range(count)]
    return {name: memoryview(data)[offset : offset + length] for name, offset, length in reversed(places)}


def _tag(tags: dict[bytes, memoryview], name: bytes) -> memoryview:
    if name not in tags:
        raise ValueError(f"it lacks the tag {name.decode()}")
    return tags[name]


_PARAMETERS = 1, 3, 4, 5, 7
"""Number of parameters of each type of a parametric curve."""


def _curve(tag: memoryview) -> Curve:
    """Curve of a tag ``curv`` or ``para``."""
    kind, (count,) = bytes(tag[:4]), struct.unpack_from(">I", tag, 8)
    if kind == b"curv" and count <= _MOST_VALUES:
        values = struct.unpack_from(f">{count}H", tag, 12)
        return bytes(tag[12 : 12 + 2 * count]) if count > 1 else _gamma(values[0] / 256 if values else 1.0)
    if kind != b"para" or count >> 16 >= len(_PARAMETERS):
        raise ValueError(f"a curve is of type {kind.decode('latin-1')!a} {count}")
    count = _PARAMETERS[count >> 16]
    g, *given = (number / 65536 for number in struct.unpack_from(f">{count}i", tag, 12))
    a, b, *rest = given or (1.0, 0.0)
    if g <= 0 or a <= 0:
        raise ValueError("a curve does not rise from black to white")
    if count < 5:  # constant up to -b/a
        return g, a, b, 0.0, -b / a, *(rest or (0.0,)) * 2
    c, d, e, f = (*rest, 0.0, 0.0)[:4]
    return g, a, b, c, d, e, f


def _description(tags: dict[bytes, memoryview]) -> str:
    """Name of a profile, in its first language."""
    tag = bytes(tags.get(b"desc", b""))
    if tag.startswith(b"mluc"):
        length, offset = struct.unpack_from(">II", tag, 20)
        return tag[offset : offset + length].decode("utf-16-be", "replace")
    return tag[12:].partition(b"\0")[0].decode("latin-1")
