"""Decode Radiance pictures (RGBE): flat, or with runs by channel.

OpenCV 5 ignores EXPOSURE, and decodes from a temporary file. Format: Ward, "Real Pixels", Graphics Gems II, 1991, and
the manual of Radiance, "File Formats".
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import SourceError
from unprocess_gen.simulation.kernels.jit import kernel
from unprocess_gen.sources.linear.pixels import SRGB, Light, chromaticity_text

HEADER = re.compile(rb"#\?[^\n]*\n((?:[^\n]+\n)*)\n(-Y (\d{1,9}) \+X (\d{1,9})|[^\n]*)\n")
SHORTEST, LONGEST = 8, 0x7FFF
"""Widths between which runs are possible."""


def decode_radiance(content: bytes, max_pixels: int) -> Light:
    """Decode a picture and divide it by its exposures; SourceError if it is damaged or has another layout.

    A mantissa m with the exponent e is the light m · 2^(e - 136).
    """
    header = HEADER.match(content)
    if header is None or header[3] is None:
        stored = "" if header is None else header[2][:40].decode("ascii", "replace")
        problem = f"is stored as {stored}" if header else "has no header of Radiance"
        raise SourceError("unsupported", f"{problem}; expected #?RADIANCE, and rows as -Y height +X width")
    height, width = int(header[3]), int(header[4])
    if height * width > max_pixels:
        raise SourceError("too_large", f"has {width} x {height} pixels; expected source.max_pixels={max_pixels}")
    exposure, stated = 1.0, SRGB
    for line in header[1].decode("ascii", "replace").splitlines():
        name, _, value = (text.strip() for text in line.partition("="))
        try:
            if name == "EXPOSURE":
                exposure *= float(value)
            elif name == "PRIMARIES":
                stated = chromaticity_text(map(float, value.split()))
        except ValueError as error:
            raise SourceError("corrupt", f"states {name}={value[:40]}; expected numbers") from error
        if (name == "FORMAT" and value != "32-bit_rle_rgbe") or name == "COLORCORR":
            raise SourceError("unsupported", f"states {name}={value[:40]}; expected FORMAT=32-bit_rle_rgbe alone")
    if not 0 < exposure < np.inf:
        raise SourceError("corrupt", f"states the exposure {exposure:g}; expected more than 0")
    if (len(content) - header.end()) * LONGEST < height * width:  # no encoding is that short
        raise SourceError("truncated", f"ends before its {width} x {height} pixels")
    codes = np.zeros((height, width, 4), np.uint8)
    row = _fill_codes(np.frombuffer(content, np.uint8, offset=header.end()), codes)
    if row < height:
        raise SourceError(
            "corrupt",
            f"ends, contradicts itself, or repeats pixels, in row {row} of {height}; expected runs by channel",
        )
    step = np.where(codes[..., 3:] > 0, np.ldexp(1.0, codes[..., 3:].astype(np.int64) - 136), 0.0)
    with np.errstate(over="ignore", under="ignore"):  # infinite light is refused
        return Light((codes[..., :3] * step / exposure).astype(np.float32), stated)


@kernel
def _fill_codes(data: NDArray[np.uint8], codes: NDArray[np.uint8]) -> Any:
    """Decode rows of mantissas and exponents, and return the number of intact rows."""
    height, width = codes.shape[:2]
    place, size = np.int64(0), data.size
    for y in range(height):
        is_new = SHORTEST <= width <= LONGEST and place + 4 <= size and data[place] == 2 and data[place + 1] == 2
        if is_new and data[place + 2] < 128:
            if (np.int64(data[place + 2]) << 8) + data[place + 3] != width:
                return y
            place += 4
            for channel in range(4):
                x = np.int64(0)
                while x < width:
                    if place + 2 > size:
                        return y
                    count = np.int64(data[place])
                    is_run = count > 128
                    count -= 128 * is_run
                    if count == 0 or x + count > width or place + (2 if is_run else 1 + count) > size:
                        return y
                    for n in range(count):
                        codes[y, x + n, channel] = data[place + 1 + (0 if is_run else n)]
                    x, place = x + count, place + (2 if is_run else 1 + count)
            continue
        if place + 4 * width > size:
            return y
        for column in range(width):
            codes[y, column] = data[place : place + 4]
            if codes[y, column, 0] == 1 and codes[y, column, 1] == 1 and codes[y, column, 2] == 1:
                return y  # repeats the last pixel in an encoding of before 1991
            place += 4
    return height
