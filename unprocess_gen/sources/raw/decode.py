"""Decode the mosaic of a raw file: with LibRaw, or with tifffile where LibRaw lacks the compression (JPEG XL)."""

from __future__ import annotations

import io
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.libraries import require
from unprocess_gen.sources.raw.metadata import (
    CFA,
    JPEG_XL,
    RawMetadata,
    decoder_facts,
    opened_by_libraw,
    tags_of,
    tiff_pages,
)

XTRANS_CELL = 6
"""Side of the CFA tile of X-Trans; the tile of Bayer has 2."""


@dataclass(frozen=True, slots=True)
class RawFrame:
    """Visible part of a mosaic, and what its file states.

    Attributes
    ----------
    pixels : ndarray of uint16, [H, W]
        DN, without masked borders.
    metadata : RawMetadata
        Facts; levels and pattern of the visible part.
    xtrans : ndarray of uint8, [6, 6] or None
        Colour of the sites of the top-left tile of X-Trans: 0 red, 1 or 3 green, 2 blue; None for a Bayer mosaic.
    """

    pixels: NDArray[np.uint16]
    metadata: RawMetadata
    xtrans: NDArray[np.uint8] | None = None


def decoder_versions() -> dict[str, str]:
    """Return the versions that decide how raw files are decoded."""
    import rawpy

    return {"rawpy": version("rawpy"), "libraw": ".".join(map(str, rawpy.libraw_version))}


def decode_raw(content: bytes, max_pixels: int = 2**40) -> RawFrame:
    """Decode the bytes of a raw file.

    Raises SourceError if they are damaged or no mosaic, and ConfigError if a library is missing.
    """
    for library in ("tifffile", "rawpy"):
        require(library, f"raw files need {library}", "raw", ", or convert the frames to NPY")
    facts = tags_of(content)
    decode = _decode_jpeg_xl if facts.compression == JPEG_XL else _decode_with_libraw
    return decode(content, facts, max_pixels)


def _decode_with_libraw(content: bytes, facts: RawMetadata, max_pixels: int) -> RawFrame:
    with opened_by_libraw(content) as raw:
        _check_pixels(raw.sizes.width, raw.sizes.height, max_pixels)
        side = len(raw.raw_pattern)
        if side not in (2, XTRANS_CELL) or raw.num_colors != 3:
            raise SourceError("unsupported", f"has a CFA of {side} x {side} sites and {raw.num_colors} colours")
        completed = facts.completed(decoder_facts(raw))
        if facts.area is not None and facts.pattern is not None:
            # LibRaw moves odd margins to even ones, and then confuses the black levels of the sites
            return RawFrame(_visible(raw.raw_image, facts.area), completed)
        xtrans = raw.raw_colors_visible[:side, :side].copy() if side == XTRANS_CELL else None
        return RawFrame(raw.raw_image_visible.copy(), completed, xtrans)


def _decode_jpeg_xl(content: bytes, facts: RawMetadata, max_pixels: int) -> RawFrame:
    """Decode a DNG 1.7 whose mosaic is stored as interleaved fields, each compressed with JPEG XL."""
    require("imagecodecs", "DNG files with JPEG XL need imagecodecs", "jxl", ", or convert them with another codec")
    import tifffile

    with tifffile.TiffFile(io.BytesIO(content)) as file:
        page: Any = next(page for page in tiff_pages(file) if page.tags.valueof(262) == CFA)
        height, width = page.shape
        area = facts.area or (0, 0, height, width)
        _check_pixels(area[3] - area[1], area[2] - area[0], max_pixels)
        rows, columns = (int(page.tags.valueof(code) or 1) for code in (50975, 52547))
        try:
            stored = page.asarray()
        except Exception as error:  # imagecodecs has no common class of errors
            raise SourceError("corrupt", f"its JPEG XL tiles cannot be decoded ({error})") from error
        fields = stored.reshape(rows, height // rows, columns, width // columns)
        pixels = _visible(fields.transpose(1, 0, 3, 2).reshape(height, width), area)
    if pixels.dtype != np.uint16 or facts.pattern is None:
        raise SourceError("unsupported", f"is a mosaic of {pixels.dtype}; expected uint16 and a Bayer pattern")
    return RawFrame(pixels, facts.completed(RawMetadata()))


def _visible(stored: NDArray[np.uint16], area: tuple[int, int, int, int]) -> NDArray[np.uint16]:
    """Return a copy of the visible part of a mosaic."""
    top, left, bottom, right = area
    if not (0 <= top < bottom <= stored.shape[0] and 0 <= left < right <= stored.shape[1]):
        raise SourceError(
            "corrupt", f"its ActiveArea {area} is not inside of its {stored.shape[1]} x {stored.shape[0]} sites"
        )
    return stored[top:bottom, left:right].copy()


def _check_pixels(width: int, height: int, max_pixels: int) -> None:
    if width * height > max_pixels:
        raise SourceError("too_large", f"has {width} x {height} pixels; expected source.max_pixels={max_pixels}")
