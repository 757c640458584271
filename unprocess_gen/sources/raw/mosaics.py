"""Read mosaics that a camera recorded: NPY, 16-bit PNG and TIFF, and raw files (extra ``raw``)."""

from __future__ import annotations

import functools
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError, SourceChangedError, SourceError
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.sources.image.decode import decode
from unprocess_gen.sources.raw.decode import RawFrame, decode_raw


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Decoded mosaic [H, W], with the black level and the CFA pattern that a raw file states."""

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
        except (ValueError, EOFError, AttributeError) as error:
            text = str(error).splitlines()[0] if str(error) else "no array"
            raise SourceError("corrupt", f"cannot be decoded ({text})") from error
    picture = decode(content, max_pixels=max_pixels, icc="ignore")
    gray = picture.srgb[..., 0]
    if picture.orientation != 1 or (picture.srgb != gray[..., None]).any():
        problem = "is rotated" if picture.orientation != 1 else "has colours"
        raise SourceError("unsupported", f"{problem}; expected a gray picture of 16 bits: the mosaic")
    return np.ascontiguousarray(gray)


def read_mosaic(path: Path, key: str, numbers: bool = False) -> Mosaic:
    """Read a mosaic of 16-bit integers, or with ``numbers`` of integers or floats.

    Raises ConfigError or MachineError.
    """
    suffix = path.suffix.lower()
    with machine_errors(path):
        content = path.read_bytes()
    try:
        if suffix in RAW_FILES:
            return _bayer(path, key, decode_raw(content))
        pixels = mosaic_pixels(content, suffix)
    except SourceError as error:
        raise ConfigError(f"{key}: {path} {error.text}") from error
    _check_numbers(path, key, pixels, numbers)
    return Mosaic(pixels)


def map_mosaic(path: Path, key: str) -> NDArray[Any]:
    """Map the mosaic of an NPY file into memory.

    The result is array, [H, W]. Raises ConfigError or MachineError.
    """
    try:
        with machine_errors(path):
            pixels: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:  # an edited row can name any file of the folder
        raise ConfigError(f"{key}: {path} cannot be decoded ({str(error).splitlines()[0]})") from error
    _check_numbers(path, key, pixels)
    return pixels


def even_sides(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return a mosaic without its last row or column if their number is odd.

    The result is array, [H, W].
    """
    return pixels[: pixels.shape[0] // 2 * 2, : pixels.shape[1] // 2 * 2]


def _check_numbers(path: Path, key: str, pixels: NDArray[Any], numbers: bool = False) -> None:
    """Raise ConfigError unless an array is a mosaic of 16-bit integers, or with ``numbers`` of integers or floats."""
    allowed = pixels.dtype.kind in "iuf" if numbers else pixels.dtype == np.uint16
    if not allowed or pixels.ndim != 2:
        expected = "integers or floats" if numbers else "uint16"
        raise ConfigError(
            f"{key}: {path} is {pixels.dtype} {list(pixels.shape)}; expected a mosaic [H, W] of {expected}"
        )


def _bayer(path: Path, key: str, frame: RawFrame) -> Mosaic:
    blacks = set(frame.metadata.black_dn or ())
    if len(blacks) != 1:
        levels = ", ".join(f"{black:g}" for black in sorted(blacks)) or "none"
        raise ConfigError(
            f"{key}: {path} states the black levels {levels}; expected one; convert the frames to NPY, and set "
            "noise.dark_frames_black_dn"
        )
    return Mosaic(frame.pixels, blacks.pop(), frame.metadata.pattern)


# ------------------------------------------------------------------------------------------------------------ digests


def mosaic_sha256(path: Path) -> str:
    """Return the SHA-256 of a file; a program that makes many pairs hashes each file once.

    Raises OSError.
    """
    status = path.stat()
    return _sha256_of(path, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=4096)
def _sha256_of(path: Path, size: int, modified_ns: int) -> str:
    return file_sha256(path)


def check_sha256(path: Path, what: str, sha256: str) -> None:
    """Compare the bytes of a file with a digest.

    Raises SourceChangedError.
    """
    try:
        digest = mosaic_sha256(path)
    except OSError as error:
        raise SourceChangedError(f"{what} {path}: cannot be read ({error.strerror}); restore it") from error
    if digest != sha256:
        raise SourceChangedError(f"{what} {path}: has the SHA-256 {digest}; expected {sha256}; restore it")
