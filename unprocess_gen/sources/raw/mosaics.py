"""Read mosaics that a camera recorded: NPY, 16-bit PGM, PNG and TIFF, and raw files (extra ``raw``)."""

from __future__ import annotations

import io
import re
from pathlib import Path
from tokenize import TokenError
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError, SourceError, refused_files
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.sources.image.decode import decode
from unprocess_gen.sources.raw.decode import decode_raw


class Mosaic(NamedTuple):
    """Mosaic [H, W], with the black level and the CFA pattern that a raw file states."""

    pixels: NDArray[Any]
    black_dn: float | None = None
    pattern: str | None = None


def mosaic_pixels(content: bytes, suffix: str, max_pixels: int = 2**30) -> NDArray[Any]:
    """Decode the array of an NPY file, or a gray picture by the decoder of photographs, which finds missing parts.

    Raises SourceError.
    """
    if suffix == ".npy":
        try:
            pixels: NDArray[Any] = np.load(io.BytesIO(content), allow_pickle=False)
            return np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("="))
        except (ValueError, EOFError, AttributeError, TokenError) as error:
            text = str(error).splitlines()[0] if str(error) else "no array"
            raise SourceError("corrupt", f"cannot be decoded ({text})") from error
        except MemoryError as error:
            np.empty(4 * len(content), np.uint8)  # raises another one if memory is short
            raise SourceError("corrupt", f"declares an array that its {len(content)} bytes cannot hold") from error
    if suffix == ".pgm":
        return _pgm_pixels(content)
    picture = decode(content, max_pixels=max_pixels, icc="ignore")
    gray = picture.srgb[..., 0]
    if picture.orientation != 1 or (picture.srgb != gray[..., None]).any():
        problem = "is rotated" if picture.orientation != 1 else "has colours"
        raise SourceError("unsupported", f"{problem}; expected a gray picture of 16 bits: the mosaic")
    return np.ascontiguousarray(gray)


def _pgm_pixels(content: bytes) -> NDArray[Any]:
    """Decode a binary PGM, as ``dcraw -4 -D`` writes it."""
    header = re.match(rb"P5(?:\s|#.*\n)+(\d+)(?:\s|#.*\n)+(\d+)(?:\s|#.*\n)+(\d+)\s", content)
    if header is None:
        raise SourceError("unsupported", "is no binary PGM (P5); expected 16 bits, as of dcraw -4 -D")
    width, height, largest = map(int, header.groups())
    dtype = np.dtype(">u2" if largest > 255 else "u1")
    if len(content) - header.end() < width * height * dtype.itemsize:
        raise SourceError("truncated", f"ends before its {width} x {height} pixels")
    pixels = np.frombuffer(content, dtype, width * height, header.end()).reshape(height, width)
    if pixels.max(initial=0) > largest:
        raise SourceError("corrupt", f"has values above {largest}, the largest that its header declares")
    return pixels.astype(dtype.newbyteorder("="))


def read_mosaic(path: Path, key: str, numbers: bool = False, white_dn: float | None = None) -> Mosaic:
    """Read a mosaic of 16-bit integers, or with ``numbers`` of integers or floats; ``key`` begins messages.
    ``white_dn`` is as for `decode_raw`.

    Raises ConfigError or MachineError.
    """
    suffix = path.suffix.lower()
    with machine_errors(path), refused_files(f"{key}: {path}"):
        content = path.read_bytes()
        if suffix not in RAW_FILES:
            return Mosaic(checked_mosaic(mosaic_pixels(content, suffix), path, key, numbers))
        frame = decode_raw(content, suffix, white_dn=white_dn)
    blacks = set(frame.metadata.black_dn or ())
    if len(blacks) != 1:
        levels = ", ".join(f"{black:g}" for black in sorted(blacks)) or "none"
        raise ConfigError(
            f"{key}: {path} states the black levels {levels}; expected one; convert the frames to NPY, and set "
            "noise.dark_frames_black_dn"
        )
    return Mosaic(frame.pixels, blacks.pop(), frame.metadata.pattern)


def checked_mosaic(pixels: NDArray[Any], path: Path, key: str, numbers: bool = False) -> NDArray[Any]:
    """The array itself; ConfigError unless it is a mosaic of 16-bit integers, or of the kinds of `read_mosaic`."""
    allowed = pixels.dtype.kind in "iuf" if numbers else pixels.dtype == np.uint16
    if not allowed or pixels.ndim != 2:
        expected = "integers or floats" if numbers else "uint16"
        raise ConfigError(
            f"{key}: {path} is {pixels.dtype} {list(pixels.shape)}; expected a mosaic [H, W] of {expected}"
        )
    return pixels


def even_sides(pixels: NDArray[Any]) -> NDArray[Any]:
    """A mosaic without its last row or column if their number is odd."""
    return pixels[: pixels.shape[0] // 2 * 2, : pixels.shape[1] // 2 * 2]
