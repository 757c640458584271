"""Describe the pixel formats and colour tags of video, and convert planes to RGB in integer arithmetic.

OpenCV reads videos through swscale, whose AVX2 and SSE2 code round differently. FFmpeg's decoders are therefore asked
for their own planes, and chroma and colours are computed here with integers, alike on every machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.jit import kernel
from unprocess_gen.core.types import Srgb

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext
    from av.video.frame import VideoFrame
    from av.video.plane import VideoPlane


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """Hold the memory layout of a pixel format.

    Attributes
    ----------
    shift_x, shift_y : int
        Base-2 logarithm of the chroma subsampling in width and height.
    bits : int
        Bits of a sample.
    rgb : bool
        Whether the components are R, G and B instead of Y, U and V.
    planes, offsets, steps : tuple of int
        For each component: its plane, its first sample in a line, and the distance between its samples.
    """

    shift_x: int = 0
    shift_y: int = 0
    bits: int = 8
    rgb: bool = False
    planes: tuple[int, ...] = (0, 1, 2)
    offsets: tuple[int, ...] = (0, 0, 0)
    steps: tuple[int, ...] = (1, 1, 1)


def _packed(offsets: tuple[int, int, int], step: int) -> PixelFormat:
    return PixelFormat(rgb=True, planes=(0, 0, 0), offsets=offsets, steps=(step,) * 3)


PIXEL_FORMATS = {
    **{f"{kind}420p": PixelFormat(1, 1) for kind in ("yuv", "yuvj")},
    **{f"{kind}422p": PixelFormat(1, 0) for kind in ("yuv", "yuvj")},
    **{f"{kind}444p": PixelFormat() for kind in ("yuv", "yuvj")},
    "yuv420p10le": PixelFormat(1, 1, bits=10),
    "yuv422p10le": PixelFormat(1, 0, bits=10),
    "yuv444p10le": PixelFormat(bits=10),
    "nv12": PixelFormat(1, 1, planes=(0, 1, 1), offsets=(0, 0, 1), steps=(1, 2, 2)),
    "gray": PixelFormat(planes=(0,)),
    "gbrp": PixelFormat(rgb=True, planes=(2, 0, 1)),
    "rgb24": _packed((0, 1, 2), 3),
    "bgr24": _packed((2, 1, 0), 3),
    "rgb0": _packed((0, 1, 2), 4),
    "bgr0": _packed((2, 1, 0), 4),
}
"""Accepted pixel formats, by FFmpeg's name."""

# Code points of ISO/IEC 23091-2 (ITU-T H.273), which all containers and codecs use.
_UNTAGGED = 2
_LUMA = {
    1: ("0.2126", "0.0722"),  # BT.709
    5: ("0.299", "0.114"),  # BT.601
    6: ("0.299", "0.114"),
    9: ("0.2627", "0.0593"),  # BT.2020, non-constant luminance
}
"""Weights of red and blue in luma, by matrix code (H.273, table 4)."""

_DISPLAYED = (1, _UNTAGGED, 4, 5, 6, 7, 11, 12, 13, 14, 15)
"""Transfer characteristics of displays of standard dynamic range (H.273, table 3); PQ, HLG, log and linear are not."""

_SRGB_PRIMARIES = (1, _UNTAGGED)
_FULL_RANGE, _UNTAGGED_RANGE = 2, 0


@dataclass(frozen=True, slots=True)
class PixelTags:
    """Hold what a stream or a frame declares about its pixels; codes of H.273."""

    pix_fmt: str | None
    width: int
    height: int
    matrix: int
    transfer: int
    primaries: int
    range: int

    @classmethod
    def of(cls, tagged: VideoCodecContext | VideoFrame, pix_fmt: str | None) -> PixelTags:
        """Return the tags of a stream or a frame."""
        codes = (int(tagged.colorspace), int(tagged.color_trc), int(tagged.color_primaries), int(tagged.color_range))
        return cls(pix_fmt, tagged.width, tagged.height, *codes)


def refuse(tags: PixelTags, max_pixels: int, icc: str) -> None:
    """Raise SourceError if pixels cannot be read as sRGB: ``too_large``, ``alpha``, ``unsupported``, ``icc``."""
    pixels = tags.width * tags.height
    if pixels > max_pixels:
        size = f"{tags.width} x {tags.height} pixels"
        raise SourceError("too_large", f"{size} are {pixels}, more than source.max_pixels={max_pixels}")
    if _has_alpha(tags.pix_fmt):
        raise SourceError("alpha", f"the pixel format {tags.pix_fmt} has an alpha channel; flatten the video")
    if tags.pix_fmt not in PIXEL_FORMATS:
        raise SourceError(
            "unsupported", f"the pixel format is {tags.pix_fmt}, expected one of {', '.join(PIXEL_FORMATS)}"
        )
    if tags.transfer not in _DISPLAYED:
        raise SourceError(
            "unsupported", f"the transfer function is not that of a display (code {tags.transfer}: HDR, log or linear)"
        )
    form = PIXEL_FORMATS[tags.pix_fmt]
    if not form.rgb and len(form.planes) == 3 and tags.matrix not in (*_LUMA, _UNTAGGED):
        raise SourceError("unsupported", f"the colour matrix has code {tags.matrix}, expected BT.601, 709 or 2020")
    if form.rgb and tags.range not in (_FULL_RANGE, _UNTAGGED_RANGE):
        raise SourceError("unsupported", "the RGB is of limited range")
    if icc == "refuse" and tags.primaries not in _SRGB_PRIMARIES:
        raise SourceError("icc", f"the primaries have code {tags.primaries}, not sRGB's; or set source.icc=ignore")


def _has_alpha(pix_fmt: str | None) -> bool:
    return pix_fmt is not None and pix_fmt.startswith(("yuva", "rgba", "bgra", "argb", "abgr", "gbrap", "ya8", "ya16"))


SHIFT = 32
"""Binary places of the factors; their rounding changes no result by more than 4e-7 codes."""


def rgb(frame: VideoFrame) -> Srgb:
    """Return stored pixels, uint8 or uint16 ``[H, W, 3]``; a chroma sample serves all pixels that share it."""
    tags = PixelTags.of(frame, frame.format.name)
    form = PIXEL_FORMATS[frame.format.name]
    planes = [_samples(frame, form, component) for component in range(len(form.planes))]
    if form.rgb:
        return cast(Srgb, np.stack(planes, axis=-1))
    full = tags.range == _FULL_RANGE or (tags.range == _UNTAGGED_RANGE and tags.pix_fmt in _FULL_UNTAGGED)
    luma, *chroma = planes
    if not chroma:
        chroma = [np.full((1, 1), 1 << form.bits - 1, luma.dtype)] * 2
        form = PixelFormat(32, 32, form.bits)
    out = np.empty((*luma.shape, 3), np.uint16 if form.bits > 8 else np.uint8)
    _yuv_to_rgb(luma, chroma[0], chroma[1], form.shift_x, form.shift_y, _matrix(_kind(tags), full, form.bits), out)
    return cast(Srgb, out)


_FULL_UNTAGGED = ("gray", "yuvj420p", "yuvj422p", "yuvj444p")


def _kind(tags: PixelTags) -> int:
    """Return the matrix code; untagged video above standard definition counts as BT.709, as in players."""
    if tags.matrix in _LUMA:
        return tags.matrix
    return 1 if tags.width >= 1280 or tags.height > 576 else 6


def _samples(frame: VideoFrame, form: PixelFormat, component: int) -> NDArray[Any]:
    """Return the samples of one component, Y, U or V (R, G or B), as a view of the decoder's memory."""
    plane = frame.planes[form.planes[component]]
    dtype, step, offset = np.dtype("<u2" if form.bits > 8 else "u1"), form.steps[component], form.offsets[component]
    chroma = component > 0 and not form.rgb
    width = -(-frame.width >> form.shift_x) if chroma else frame.width
    height = -(-frame.height >> form.shift_y) if chroma else frame.height
    lines = _lines(plane, height)
    samples = lines[:, : lines.shape[1] // dtype.itemsize * dtype.itemsize].view(dtype)
    return cast("NDArray[Any]", samples[:, offset : offset + step * (width - 1) + 1 : step])


def _lines(plane: VideoPlane, height: int) -> NDArray[np.uint8]:
    """Return a plane's lines from the top, uint8 ``[height, bytes]``; a negative line size stores the lowest first."""
    length = abs(plane.line_size)
    content = np.frombuffer(cast(Any, plane), np.uint8)[: length * height].reshape(height, length)
    return content[::-1] if plane.line_size < 0 else content


@lru_cache(maxsize=16)
def _matrix(kind: int, full: bool, bits: int) -> NDArray[np.int64]:
    """Return the integers of a conversion: codes of black, neutral chroma and white, and five factors times 2^`SHIFT`.

    Factors are exact rationals that are rounded once. Codes of ``bits`` become 0 to 255, or 0 to 65535 above 8 bits.
    """
    red, blue = (Fraction(weight) for weight in _LUMA[kind])
    green = 1 - red - blue
    unit = 1 << bits - 8
    luma, chroma = ((1 << bits) - 1,) * 2 if full else (219 * unit, 224 * unit)
    white = 65535 if bits > 8 else 255
    factors = (
        Fraction(white, luma),
        2 * (1 - red) * Fraction(white, chroma),
        -2 * (1 - blue) * blue / green * Fraction(white, chroma),
        -2 * (1 - red) * red / green * Fraction(white, chroma),
        2 * (1 - blue) * Fraction(white, chroma),
    )
    rounded = [round(factor * (1 << SHIFT)) for factor in factors]
    return np.array([0 if full else 16 * unit, 128 * unit, white, *rounded], dtype=np.int64)


@kernel
def _yuv_to_rgb(luma, u_plane, v_plane, shift_x, shift_y, matrix, out):  # type: ignore[no-untyped-def]
    black, gray, white = matrix[0], matrix[1], matrix[2]
    half = np.int64(1) << np.int64(31)
    for y in range(luma.shape[0]):
        for x in range(luma.shape[1]):
            light = (np.int64(luma[y, x]) - black) * matrix[3] + half
            u = np.int64(u_plane[y >> shift_y, x >> shift_x]) - gray
            v = np.int64(v_plane[y >> shift_y, x >> shift_x]) - gray
            out[y, x, 0] = min(max((light + matrix[4] * v) >> 32, 0), white)
            out[y, x, 1] = min(max((light + matrix[5] * u + matrix[6] * v) >> 32, 0), white)
            out[y, x, 2] = min(max((light + matrix[7] * u) >> 32, 0), white)
