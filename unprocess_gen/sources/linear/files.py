"""Decode the file of a linear source."""

from __future__ import annotations

import io
from pathlib import PurePosixPath
from typing import Any, cast

import numpy as np

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.libraries import require
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.linear.exr import decode_exr
from unprocess_gen.sources.linear.pixels import Light, linear_photograph, linear_pixels
from unprocess_gen.sources.linear.radiance import decode_radiance
from unprocess_gen.sources.raw.mosaics import mosaic_pixels


def read_linear_source(config: SourceConfig, content: bytes, name: str) -> Photograph:
    """Decode the bytes of a linear source, whose ``name`` gives the format.

    Raises SourceError if the file is damaged or is no scene-linear picture, and ConfigError if a library is missing.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in DECODERS:
        raise SourceError("unsupported", f"has the suffix {suffix!r}; expected {', '.join(DECODERS)}")
    decoded = DECODERS[suffix](content, config.max_pixels)
    light = linear_pixels(decoded.pixels)
    if light.shape[0] * light.shape[1] > config.max_pixels:
        raise SourceError("too_large", f"is {list(light.shape)}; expected source.max_pixels={config.max_pixels}")
    return linear_photograph(config, light, decoded.primaries, decoded.note)


def _decode_npy(content: bytes, max_pixels: int) -> Light:
    return Light(mosaic_pixels(content, ".npy"))


def _decode_tiff(content: bytes, max_pixels: int) -> Light:
    """Decode a TIFF of one page of floats; alpha is left out."""
    require("tifffile", "TIFF files of floats need tifffile", "raw", ", or convert the pictures to NPY")
    from tifffile import TiffFile

    try:
        with TiffFile(io.BytesIO(content)) as file:
            pages, page = len(file.pages), cast(Any, file.pages[0])
            orientation, size = page.tags.valueof("Orientation", 1), (page.imagelength, page.imagewidth)
            is_light = page.dtype in (np.float16, np.float32) and page.shape in ((*size, 3), (*size, 4))
            colours, has_profile = int(page.photometric), "InterColorProfile" in page.tags
            if pages > 1 or orientation != 1 or not is_light or colours not in RGB:
                actual = f"{page.dtype} {list(page.shape)}, orientation {orientation}, {pages} page{'s' * (pages > 1)}"
                actual += f", photometric {colours}" * (colours not in RGB)
                problem = f"is {actual}; expected one upright page [H, W, 3] of float16 or float32"
                raise SourceError("unsupported", problem)
            if size[0] * size[1] > max_pixels:
                raise SourceError("too_large", f"is {list(page.shape)}; expected source.max_pixels={max_pixels}")
            pixels = page.asarray()
    except SourceError:
        raise
    except Exception as error:  # a damaged file raises various types
        if "imagecodecs" in str(error):
            raise SourceError("unsupported", "its compression needs imagecodecs; pip install imagecodecs") from error
        raise SourceError("corrupt", f"tifffile cannot decode it ({type(error).__name__})") from error
    notes = "has alpha, which is left out" if pixels.shape[2] > 3 else "", PROFILE_NOTE if has_profile else ""
    return Light(pixels[..., :3], note="; ".join(filter(None, notes)))


RGB = 1, 2
"""Photometric interpretations of TIFF: writers that know no better state gray for three samples."""
PROFILE_NOTE = "has a colour profile, which is not read; values are taken as linear light of source.primaries"


DECODERS = {
    ".exr": decode_exr, ".hdr": decode_radiance, ".npy": _decode_npy, ".tif": _decode_tiff, ".tiff": _decode_tiff,
}  # fmt: skip
"""Decoders by suffix; their arguments are the bytes of a file and the largest number of pixels."""
