"""Decode OpenEXR pictures (extra ``exr``): one part of scan lines or tiles with R, G, B of half or float."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from typing import Any

import numpy as np

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.libraries import require
from unprocess_gen.sources.image.codec_messages import captured
from unprocess_gen.sources.linear.pixels import SRGB, Light, chromaticity_text


def decode_exr(content: bytes, max_pixels: int) -> Light:
    """Decode the channels R, G, B, or the only set of channels ``*.R``, ``*.G``, ``*.B``.

    Raises SourceError if the file is damaged or has other pixels, and ConfigError without OpenEXR.
    """
    require("OpenEXR", "EXR files need OpenEXR", "exr", ", or convert the pictures to NPY")
    header, names, note = _header(content, max_pixels)
    channels = _opened(content, header_only=False).channels()
    pixels = np.stack([channels[name].pixels for name in names], axis=-1)
    stated = header.get("chromaticities")
    return Light(pixels, SRGB if stated is None else chromaticity_text(map(float, stated)), note)


def _opened(content: bytes, header_only: bool) -> Any:
    """Open a file; SourceError for damage, which OpenEXR raises or only prints."""
    import OpenEXR

    problem = SourceError("corrupt", "OpenEXR cannot decode all of the file")
    try:
        with captured() as messages, redirect_stdout(io.StringIO()):
            file = OpenEXR.File(io.BytesIO(content), separate_channels=True, header_only=header_only, num_threads=0)
    except Exception as error:  # its exceptions have no common class
        raise problem from error
    if messages or not file.parts:
        raise problem
    return file


def _header(content: bytes, max_pixels: int) -> tuple[dict[str, Any], list[str], str]:
    """Header of a file, the names of its channels of red, green and blue, and a note about others."""
    file = _opened(content, header_only=True)
    header = file.header()
    if len(file.parts) > 1 or "deep" in header["type"].name:
        problem = "is deep" if "deep" in header["type"].name else f"has {len(file.parts)} parts"
        raise SourceError("unsupported", f"{problem}; expected one part of flat pixels")
    (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    height, width = bottom - top + 1, right - left + 1
    if height * width > max_pixels:
        raise SourceError("too_large", f"has {width} x {height} pixels; expected source.max_pixels={max_pixels}")
    channels = {channel.name: channel for channel in header["channels"]}
    sets = [name[:-1] for name in channels if name[-2:] in ("R", ".R") and name[:-1] + "G" in channels]
    sets = [start for start in sets if start + "B" in channels]
    sets = [""] if "" in sets else sets
    if len(sets) != 1:
        found = ", ".join(sorted(channels))[:120]
        raise SourceError("unsupported", f"has the channels {found}; expected R, G, B, or one set of *.R, *.G, *.B")
    names = [sets[0] + colour for colour in "RGB"]
    if any((channels[name].xSampling, channels[name].ySampling) != (1, 1) for name in names):
        raise SourceError("unsupported", "has subsampled channels; expected a sample at each pixel")
    has_alpha = sets[0] + "A" in channels
    return header, names, "has alpha, which is left out" if has_alpha else ""
