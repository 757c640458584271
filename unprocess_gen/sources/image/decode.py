"""Decode image files to pixels, and refuse those that are not opaque, still photographs in RGB or gray.

The header decides where it can (`headers`); no file that was cut is decoded in part. Codes stay as they are in the
file; their colours are those of the profile (`profiles`).

What OpenCV does (4.13 and 5.0 agree), and what this module does about it:

* Orientation: JPEG, PNG and WebP stay as stored under ``IMREAD_IGNORE_ORIENTATION``; 8-bit TIFFs are rotated whatever
  the flags are, 16-bit ones under some. Tag 274 is therefore set to 1 in a copy, and `upright` rotates.
* 16-bit TIFF: under ``IMREAD_COLOR_RGB`` half of the bytes are swapped, so these files are decoded as stored. Then
  "white is zero" is not inverted (at 8 bits it is), and separate planes contain uninitialised memory. The first is
  inverted here, the second refused.
* Alpha: the transparent gray of a PNG (tRNS) and the alpha of a gray TIFF are dropped silently, so both are refused.
* Refused because OpenCV decodes them wrongly: 16-bit BMP (white becomes 248), CMYK JPEG (no profile is applied), TIFF
  tiles narrower than 32 pixels at 8 bits. TIFF tiles are allocated at the size they declare, so it is limited.
* Damage: codecs report it on standard error only (`codec_messages`). libjpeg reports the first problem of a file only,
  so any report of it counts as damage. Damage that still decodes as Huffman codes, and damage within a lossy WebP, is
  found by a recorded hash only.

Measured memory and decisions: ``docs/design/decoding.md``.
"""

from __future__ import annotations

import logging
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np

from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.simulation.facts import RawParts
from unprocess_gen.simulation.plan import SourcePlan
from unprocess_gen.simulation.profiles import UNCONVERTED, Profile
from unprocess_gen.sources.image.codec_messages import captured
from unprocess_gen.sources.image.headers import Header, probe, tiff_without_orientation
from unprocess_gen.sources.image.heif import avif_pixels, open_heic, widened
from unprocess_gen.sources.image.profiles import profile_of

_LOGGER = logging.getLogger(__name__)

# libtiff's messages go through OpenCV's log, which OPENCV_LOG_LEVEL could silence.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_WARNING)

ICC_CHOICES = ("convert", "ignore", "refuse")

DECODE_PEAK = 8
"""Samples per pixel that must fit into memory before a failed decode is attributed to the file; the peak is 6."""

CV2_MAX_PIXELS = 2**30
"""OpenCV refuses more, unless an environment variable changes its limit."""

CICP_HDR_TRANSFERS = {8: "linear light; source.kind=linear reads it from EXR, TIFF or NPY", 16: "PQ", 18: "HLG"}
"""Transfer functions whose codes are not display-referred (ITU-T H.273, table 3)."""

# What libjpeg and libtiff write when they fill in missing or broken data and continue. One libjpeg warning is harmless:
# a few bytes before the end marker, as some cameras write them.
_DAMAGE = re.compile(
    rb"[Pp]remature end|Corrupt JPEG data(?!: \d{1,2} extraneous bytes before marker 0xd9)|bad Huffman code"
    rb"|[Ii]nconsistent progression|Invalid SOS parameters|unknown JFIF revision|Unknown Adobe color"
    rb"|Unsupported marker|JPEGLib:|Improper JPEG strip/tile size|PackBitsDecode: Discarding|TIFF_Error"
)

_LOG_PREFIX = re.compile(r"\[ *[A-Z]+:\d+@[\d.]+\] global \S+ \S+ ")
"""Severity, seconds since the start, file and function of an OpenCV message; they would make manifests differ."""

_BY_VERSION = "heic", "avif"
"""Formats whose pixels depend on the version of the decoder."""

_COLOUR = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
_COLOUR_16 = _COLOUR | cv2.IMREAD_ANYDEPTH


@dataclass(frozen=True, slots=True)
class Photograph:
    """Decoded pixels ``srgb``, uint8 or uint16 [H, W, 3], R, G, B, after applying the EXIF ``orientation``.

    A raw source has codes of its camera RGB, and ``raw`` is what the file states. A linear source has light, float32,
    and ``source`` is what the file states. Codes are not converted from ``profile``; the simulation converts them.
    ``pixels_xxh3`` is the digest of pixels that depend on the version of their decoder. ``note`` is a warning.
    """

    srgb: Srgb
    orientation: int
    raw: RawParts | None = None
    note: str = ""
    profile: Profile = UNCONVERTED
    pixels_xxh3: str = ""
    source: SourcePlan | None = None


def decode(data: bytes, *, max_pixels: int, icc: str, name: str = "image") -> Photograph:
    """Decode the bytes of one photograph to uint8 or uint16 ``[H, W, 3]``, R, G, B, upright and contiguous.

    ``max_pixels`` limits what the header declares, ``name`` begins log messages. Raises SourceError with the first
    reason found of: ``empty``, ``unsupported``, ``truncated``, ``too_large``, ``animated``, ``cmyk``, ``icc``,
    ``corrupt``, ``alpha``. Headers that are refused while they are read (a gray TIFF with alpha, an impossible header)
    give ``alpha`` or ``corrupt`` before the others are checked.
    """
    header = probe(data)
    _refuse(header, max_pixels)
    profile = _profile(header, icc)
    is_stored = header.has_alpha or (header.format == "tiff" and header.bits == 16)  # B, G, R, alpha by OpenCV
    is_rgb = header.format == "heic" or (header.format == "avif" and header.bits == 8)
    if is_rgb:
        decoded: Srgb = open_heic(data, is_decoded=True) if header.format == "heic" else avif_pixels(data)
    else:
        flags = cv2.IMREAD_UNCHANGED if is_stored else _COLOUR_16 if header.bits > 8 else _COLOUR
        decoded = _decode_by_opencv(data, header, flags, name)
    if header.bits not in (8, 16):
        decoded, header = widened(decoded, header.bits), replace(header, bits=16)
    _check(decoded, header)
    if header.mode == "white_is_zero" and header.bits == 16:
        np.subtract(65535, decoded, out=decoded)
    if decoded.ndim == 2:
        decoded = cast(Srgb, np.repeat(decoded[..., None], 3, axis=2))
    elif is_stored:
        decoded = decoded[..., :3] if is_rgb else decoded[..., 2::-1]
    srgb = _upright(decoded, header.orientation)
    digest = array_xxh3(srgb) if header.format in _BY_VERSION else ""
    return Photograph(srgb, header.orientation, None, header.note, profile, digest)


def read_profile(data: bytes) -> Profile:
    """Profile of a photograph, from which its colours are converted, without decoding pixels; raise as `decode`."""
    return _profile(probe(data), "convert")


def _decode_by_opencv(data: bytes, header: Header, flags: int, name: str) -> Srgb:
    """Decode pixels as they are stored; SourceError for every damage that a codec reports."""
    content = np.frombuffer(tiff_without_orientation(data) if header.format == "tiff" else data, np.uint8)
    decoded: Srgb | None = None
    with captured() as written, suppress(cv2.error):
        decoded = cast("Srgb | None", cv2.imdecode(content, flags))
    if decoded is None:  # codecs report a lack of memory in many ways, or not at all: MemoryError if there is one
        np.empty((header.height, header.width, DECODE_PEAK), f"uint{header.bits}")
    messages = bytes(written)
    text = " ".join(_LOG_PREFIX.sub("", messages.decode(errors="replace")).split())
    damage = _DAMAGE.search(messages)
    if decoded is None or damage:
        # only the recognised words go into the manifest: the others differ between versions of the codecs
        _LOGGER.debug("%s: %s", name, text)
        words = damage[0].decode() if damage else "the codec fails"
        raise SourceError("corrupt", f"OpenCV cannot decode all of the {header.format} data: {words}")
    if text:
        _LOGGER.warning("%s: %s", name, text)
    return decoded


# Pixels ---------------------------------------------------------------------------------------------------------------


def _check(decoded: Srgb, header: Header) -> None:
    """Raise SourceError for another array than the header declares, and for pixels that are or may be transparent.

    OpenCV drops the transparent value of gray.
    """
    expected = (header.height, header.width, f"uint{header.bits}")
    actual = (*decoded.shape[:2], decoded.dtype.name)
    if actual != expected:
        raise SourceError("corrupt", f"the header declares {expected} (rows, columns, type), the data have {actual}")
    if header.has_alpha and (
        decoded.ndim == 2 or (decoded.shape[2] == 4 and decoded[..., 3].min() < 2**header.bits - 1)
    ):
        raise SourceError("alpha", "some pixels may be transparent; flatten the picture onto a background")


def _upright(srgb: Srgb, orientation: int) -> Srgb:
    """Rotate and mirror stored pixels by an EXIF orientation, 1 to 8 (tag 274)."""
    turned = srgb.swapaxes(0, 1) if orientation > 4 else srgb
    row_step, column_step = (-1 if orientation in mirrored else 1 for mirrored in ((3, 4, 7, 8), (2, 3, 6, 7)))
    return cast(Srgb, np.ascontiguousarray(turned[::row_step, ::column_step]))


# Policy ---------------------------------------------------------------------------------------------------------------


def _refuse(header: Header, max_pixels: int) -> None:
    pixels = header.width * header.height
    limit = min(max_pixels, CV2_MAX_PIXELS)
    size = f"{header.width} x {header.height} pixels"
    if header.missing:
        raise SourceError("truncated", f"the file of {size} lacks {header.missing}")
    if pixels > limit:
        raise SourceError("too_large", f"{size} are {pixels}, more than source.max_pixels={limit}")
    if header.frames > 1:
        raise SourceError("animated", f"the file holds {header.frames} pictures, expected 1")
    if header.mode == "cmyk":
        raise SourceError("cmyk", "the pixels are printing inks (CMYK); convert the picture to sRGB")


def _profile(header: Header, icc: str) -> Profile:
    """Profile from which colours are converted; SourceError if they are not display-referred RGB, or are refused."""
    if header.cicp is not None:
        primaries, transfer, matrix, full_range = header.cicp
        declared = f"the colours are declared as primaries {primaries}, transfer {transfer}, matrix {matrix} (cICP)"
        if transfer in CICP_HDR_TRANSFERS:
            raise SourceError("icc", f"{declared}: {CICP_HDR_TRANSFERS[transfer]}, not display-referred")
        if matrix != 0 or full_range != 1:
            raise SourceError("unsupported", f"{declared}, full range {full_range}: not full-range RGB")
    if icc == "ignore":
        return UNCONVERTED
    profile = profile_of(header)
    if icc == "refuse" and not profile.is_srgb:
        raise SourceError("icc", f"the colour profile {profile.name} is not sRGB; set source.icc=convert or ignore")
    return profile if icc == "convert" else UNCONVERTED
