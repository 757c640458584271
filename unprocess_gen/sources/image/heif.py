"""Decode HEIC by libheif (pillow-heif), and read facts about AVIF that Pillow does not report.

Libheif rotates pixels, and conceals damage: only the recorded digest of the pixels shows it.
"""

from __future__ import annotations

import io
import re
from importlib.util import find_spec
from typing import Any

import numpy as np

from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.errors import SourceError

_FAILURES = ValueError, EOFError, SyntaxError, RuntimeError, OSError, LookupError
"""Exceptions of pillow-heif and Pillow for broken files."""

SEQUENCES = b"hevc", b"hevx", b"msf1"
"""Brands of sequences of pictures in HEIC."""


def open_heic(data: bytes, is_decoded: bool = False) -> Any:
    """Read facts, size, mode and number of pictures of a HEIC file, or its codes as stored, [H, W] or [H, W, 3 or 4].

    Raises SourceError if libheif cannot read the file, or is not installed.
    """
    if find_spec("pillow_heif") is None:
        problem = "HEIC is read by pillow-heif; run: pip install 'unprocess_gen[heic]', or convert it to JPEG"
        raise SourceError("unsupported", problem)
    import pillow_heif

    try:
        picture = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False, hdr_to_16bit=False)
        return np.asarray(picture) if is_decoded else (picture.info, picture.size, picture.mode, len(picture))
    except _FAILURES as error:
        raise SourceError("corrupt", f"libheif cannot read the file ({type(error).__name__})") from error


def avif_pixels(data: bytes) -> Srgb:
    """Decode AVIF to stored codes of 8 bits; OpenCV decodes fewer files. SourceError if it fails."""
    from PIL import AvifImagePlugin

    try:
        return np.asarray(AvifImagePlugin.AvifImageFile(io.BytesIO(data)))
    except _FAILURES as error:
        raise SourceError("corrupt", f"libavif cannot decode the file ({type(error).__name__})") from error


def avif_facts(data: bytes) -> tuple[int, tuple[int, int] | None]:
    """Bits of the codes of an AVIF file, and code points of primaries and transfer if it states them."""
    config, points = re.search(rb"av1C\x81.(.)", data, re.DOTALL), re.search(rb"colrnclx(..)(..)", data, re.DOTALL)
    flags = config[1][0] if config else 0
    bits = 8 if not flags & 0x40 else 12 if flags & 0x20 else 10  # high_bitdepth, twelve_bit
    return bits, (int.from_bytes(points[1]), int.from_bytes(points[2])) if points else None


def widened(codes: Srgb, bits: int) -> Srgb:
    """Codes of 10 or 12 bits, scaled to the nearest 16-bit codes."""
    white = 2**bits - 1
    table = ((np.arange(white + 1) * 65535 + white // 2) // white).astype(np.uint16)
    wide = np.empty(codes.shape, np.uint16)
    for narrow, row in zip(codes, wide, strict=True):  # indices of all pixels at once would take 8 bytes each
        table.take(narrow, out=row, mode="clip")
    return wide
