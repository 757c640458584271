"""Decode the mosaic of a raw file with LibRaw."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.libraries import require
from unprocess_gen.sources.raw.metadata import JPEG_XL, RawMetadata, decoder_facts, opened_by_libraw, tags_of


@dataclass(frozen=True, slots=True)
class RawFrame:
    """Visible part of a Bayer mosaic, and what its file states.

    Attributes
    ----------
    pixels : ndarray of uint16, [H, W]
        DN, without masked borders.
    metadata : RawMetadata
        Facts; levels and pattern of the visible part.
    """

    pixels: NDArray[np.uint16]
    metadata: RawMetadata


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
    if facts.compression == JPEG_XL:
        raise SourceError("unsupported", "is compressed with JPEG XL; convert it to a DNG with lossless JPEG")
    with opened_by_libraw(content) as raw:
        if raw.sizes.width * raw.sizes.height > max_pixels:
            size = f"{raw.sizes.width} x {raw.sizes.height}"
            raise SourceError("too_large", f"has {size} pixels; expected source.max_pixels={max_pixels}")
        completed = facts.completed(decoder_facts(raw))
        if facts.area is None or facts.pattern is None:
            return RawFrame(raw.raw_image_visible.copy(), completed)
        # LibRaw moves odd margins to even ones, and then confuses the black levels of the sites
        top, left, bottom, right = facts.area
        height, width = raw.raw_image.shape
        if not (0 <= top < bottom <= height and 0 <= left < right <= width):
            problem = f"its ActiveArea {facts.area} is not inside of its {width} x {height} sites"
            raise SourceError("corrupt", problem)
        return RawFrame(raw.raw_image[top:bottom, left:right].copy(), completed)
