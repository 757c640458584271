"""From the bytes of a photograph to its pixels, and the policy of which photographs we take.

Everything that is not a whole, opaque, still photograph in RGB or gray is refused with a reason, from its header where
that can be told there (`headers`); no file that was cut is ever half decoded. Pillow does what we could not do better,
colour profiles, and only where they are asked for.

**What OpenCV does** (4.13 and 5.0 agree in all of it; 4.12 says nothing of broken TIFF data), and what is done:

* Orientation: JPEG, PNG and WebP stay as stored under ``IMREAD_IGNORE_ORIENTATION``. TIFFs of 8 bits are turned
  whatever the flags say, those of 16 bits under some. So tag 274 is set to 1 in a copy, and we turn.
* 16-bit TIFF: under ``IMREAD_COLOR_RGB`` the swap of channels hits half of the bytes, so these are decoded as stored.
  Then "white is zero" is not undone (at 8 bits it is), and separate planes come out as memory never written: the first
  is undone here, the second refused.
* Alpha: the transparent gray of a PNG (tRNS) and the alpha of a gray TIFF are dropped without a word. The first is
  looked up in the pixels, the second refused.
* 16-bit BMP: its white is 248; refused. CMYK JPEG: converted without a profile; refused. TIFF tiles narrower than 32
  pixels at 8 bits: an error; refused. TIFF tiles are allocated at the size they claim: limited.
* Memory: OpenCV's Python layer copies what it decoded, so a decode peaks at twice the array: 6.0 bytes for each pixel
  of a 20-megapixel JPEG (baseline, progressive or turned), of which 3 stay; 12 for 16-bit RGB, 16 for 16-bit RGBA.
  What is done here afterwards stays under that peak.
* Damage: libjpeg and libtiff fill in for data that are broken, return a picture and tell stderr. So stderr (file
  descriptor 2, of the whole process, under a lock) goes into a file while a picture is decoded, 30 microseconds; what
  tells of damage is a refusal, anything else is passed on. libjpeg tells the first trouble of a file only, so whatever
  it says is damage: a strange JFIF version may hide a lost half. Bit rot that still decodes as Huffman codes, and
  damage within a lossy WebP, is told by nobody but a hash recorded earlier.
"""

from __future__ import annotations

import io
import os
import re
import tempfile
import threading
from functools import lru_cache
from typing import cast

import cv2
import numpy as np

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.types import Photograph, Srgb
from unprocess_gen.sources.image.headers import Header, max_side, png_transparent_gray, probe, tiff_without_orientation

# libtiff's complaints go through OpenCV's log, which OPENCV_LOG_LEVEL could silence.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_WARNING)

ICC_CHOICES = ("ignore", "refuse")

SRGB_TOLERANCE = 2
"""Codes (of 255) that a profile may move a colour by and still count as sRGB; real sRGB profiles move 1."""

DECODE_PEAK = 8
"""Samples a pixel that must fit into memory before a failed decode is put down to the file; decoding peaks at 6."""

CV2_MAX_PIXELS = 2**30
"""OpenCV refuses more, unless an environment variable says otherwise."""

# What libjpeg (all of its warnings but one: a few bytes before the end marker, as some cameras write) and libtiff say
# when they fill in for data that are missing or broken, and go on.
_DAMAGE = re.compile(
    rb"[Pp]remature end|Corrupt JPEG data(?!: \d{1,2} extraneous bytes before marker 0xd9)|bad Huffman code"
    rb"|[Ii]nconsistent progression|Invalid SOS parameters|unknown JFIF revision|Unknown Adobe color"
    rb"|Unsupported marker|JPEGLib:|Improper JPEG strip/tile size|PackBitsDecode: Discarding|TIFF_Error"
)
_DECODING = threading.Lock()

_UNCHANGED = cv2.IMREAD_UNCHANGED
_COLOUR = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
_COLOUR_16 = _COLOUR | cv2.IMREAD_ANYDEPTH

# orientation -> (swap rows and columns first, row step, column step), after the EXIF standard's table of tag 274
_TURNS = {
    1: (False, 1, 1),
    2: (False, 1, -1),
    3: (False, -1, -1),
    4: (False, -1, 1),
    5: (True, 1, 1),
    6: (True, 1, -1),
    7: (True, -1, -1),
    8: (True, -1, 1),
}


def decode(data: bytes, *, max_pixels: int, icc: str) -> Photograph:
    """Decodes one photograph to uint8 or uint16 ``[H, W, 3]`` in R, G, B order, upright and contiguous.

    Parameters
    ----------
    data
        The whole file.
    max_pixels
        Refuse more than so many, judged by the header.
    icc
        ``refuse`` photographs whose profile is not sRGB, or ``ignore`` profiles.

    Raises
    ------
    SourceError
        With the first reason found of: ``empty``, ``unsupported``, ``truncated``, ``too_large``, ``animated``,
        ``cmyk``, ``icc``, ``corrupt``, ``alpha``. (A gray TIFF with alpha, and a header that makes no sense, are
        ``alpha`` and ``corrupt`` at once.)
    """
    if icc not in ICC_CHOICES:
        raise ValueError(f"icc is {icc!r}, expected one of {', '.join(ICC_CHOICES)}")
    header = probe(data)
    _refuse(header, max_pixels, icc)
    return Photograph(upright(_pixels(data, header), header.orientation), header.orientation)


# The policy -----------------------------------------------------------------------------------------------------------


def _refuse(header: Header, max_pixels: int, icc: str) -> None:
    pixels = header.width * header.height
    limit = min(max_pixels, CV2_MAX_PIXELS)
    longest = max_side(header.format)
    size = f"{header.width} x {header.height} pixels"
    if header.missing:
        raise SourceError("truncated", f"the file of {size} lacks {header.missing}")
    if pixels > limit:
        raise SourceError("too_large", f"{size} are {pixels}, more than source.max_pixels={limit}")
    if max(header.width, header.height) > longest:
        raise SourceError("too_large", f"{size}: OpenCV reads {header.format} files of up to {longest} a side")
    if header.frames > 1:
        raise SourceError("animated", f"the file holds {header.frames} pictures, expected 1")
    if header.mode == "cmyk":
        raise SourceError("cmyk", "the pixels are printing inks (CMYK); convert the picture to sRGB")
    if icc == "refuse" and header.icc is not None and (objection := _profile_objection(header.icc)):
        raise SourceError("icc", f"{objection}; convert the picture to sRGB, or set source.icc=ignore")


@lru_cache(maxsize=32)
def _profile_objection(icc: bytes) -> str:
    """Why an embedded profile is not sRGB, or an empty text. Judged by what it does: names of profiles say little."""
    from PIL import ImageCms

    try:
        moved = _codes_moved(icc)
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError, KeyError) as error:
        return f"the embedded colour profile cannot be used ({error})"
    return f"the embedded colour profile moves colours by up to {moved} codes" if moved > SRGB_TOLERANCE else ""


def _codes_moved(icc: bytes) -> int:
    """How far a profile's colours lie from sRGB: the largest difference, in codes, over a grid or over all grays."""
    from PIL import Image, ImageCms

    profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
    mode = {"RGB ": "RGB", "GRAY": "L"}[profile.profile.xcolor_space]
    grid = np.stack(np.meshgrid(*[np.arange(0, 256, 51, dtype=np.uint8)] * 3), -1).reshape(1, -1, 3)
    colours = Image.fromarray(grid if mode == "RGB" else np.arange(256, dtype=np.uint8)[None])
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    transform = ImageCms.buildTransform(profile, ImageCms.createProfile("sRGB"), mode, "RGB", renderingIntent=intent)
    seen = np.asarray(ImageCms.applyTransform(colours, transform)).astype(int)
    return int(np.abs(seen - np.asarray(colours.convert("RGB"))).max())


# Pixels ---------------------------------------------------------------------------------------------------------------


def _pixels(data: bytes, header: Header) -> Srgb:
    """The pixels as stored, ``[height, width, 3]``, R, G, B."""
    flags = _flags(header)
    decoded, said = _imdecode(tiff_without_orientation(data) if header.format == "tiff" else data, flags)
    if decoded is None:
        _check_memory(header)
    if decoded is None or _DAMAGE.search(said):
        complaint = " ".join(said.decode(errors="replace").split())[:200] or "it gives no reason"
        raise SourceError("corrupt", f"OpenCV cannot decode the {header.format} data whole: {complaint}")
    os.write(2, said)
    _check_array(decoded, header)
    if header.has_alpha:
        _check_opaque(decoded, data, header)
    if header.mode == "white_is_zero" and header.bits == 16:
        np.subtract(65535, decoded, out=decoded)
    return _as_rgb(decoded) if flags == _UNCHANGED else decoded


def _flags(header: Header) -> int:
    if header.has_alpha or (header.format == "tiff" and header.bits == 16):
        return _UNCHANGED
    return _COLOUR_16 if header.bits == 16 else _COLOUR


def _imdecode(data: bytes | bytearray, flags: int) -> tuple[Srgb | None, bytes]:
    """Decode, and return what the codec said to stderr meanwhile: the one place where it tells of half a picture."""
    with _DECODING, tempfile.TemporaryFile(buffering=0) as spool:
        stderr = os.dup(2)
        os.dup2(spool.fileno(), 2)
        try:
            decoded = cast("Srgb | None", cv2.imdecode(np.frombuffer(data, np.uint8), flags))
        except cv2.error:
            decoded = None
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        spool.seek(0)
        return decoded, spool.read()


def _check_memory(header: Header) -> None:
    """MemoryError where there is none for these pixels: codecs tell of that in many ways, or not at all."""
    np.empty((header.height, header.width, DECODE_PEAK), f"uint{header.bits}")


def _check_array(decoded: Srgb, header: Header) -> None:
    expected = (header.height, header.width, f"uint{header.bits}")
    found = (*decoded.shape[:2], decoded.dtype.name)
    if found != expected:
        raise SourceError("corrupt", f"the header says {expected} (rows, columns, type), the data {found}")


def _check_opaque(decoded: Srgb, data: bytes, header: Header) -> None:
    if header.format == "png" and decoded.ndim == 2:
        transparent = bool((decoded == png_transparent_gray(data)).any())
    else:
        transparent = decoded.ndim == 3 and decoded.shape[2] == 4 and bool(decoded[..., 3].min() < _white(header))
    if transparent:
        raise SourceError("alpha", "some pixels are transparent; flatten the picture onto a background")


def _white(header: Header) -> int:
    return (1 << header.bits) - 1


def _as_rgb(stored: Srgb) -> Srgb:
    """Gray, BGR or BGRA to RGB."""
    if stored.ndim == 2:
        return cast(Srgb, np.repeat(stored[..., None], 3, axis=2))
    return cast(Srgb, np.ascontiguousarray(stored[..., 2::-1]))


def upright(srgb: Srgb, orientation: int) -> Srgb:
    """Turns pixels as stored by an EXIF orientation."""
    swap, row_step, column_step = _TURNS[orientation]
    turned = srgb.swapaxes(0, 1) if swap else srgb
    return cast(Srgb, np.ascontiguousarray(turned[::row_step, ::column_step]))
