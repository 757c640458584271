"""Decode raw files of cameras: the mosaic, and what the file states about it.

LibRaw (rawpy) decodes the pixels. Facts come from the tags of files with the structure of TIFF (DNG, ARW, CR2, NEF,
PEF), which take precedence because LibRaw rounds black levels, and from LibRaw. A fact that neither gives is None.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.libraries import require
from unprocess_gen.simulation.reference.colour import IDENTITY, Matrix, matrix
from unprocess_gen.sources.raw.colour import LIGHT_K, DngColour

CFA, LINEAR = 32803, 34892
"""Values of PhotometricInterpretation: mosaics (TIFF/EP), and demosaicked pixels (DNG)."""
FLOATING_POINT = 3
"""Value of SampleFormat."""
RATIONALS = (5, 10)
"""Types of fractions (TIFF 6.0, section 2)."""
LOSSY_JPEG, JPEG_XL = 34892, 52546
"""Values of Compression: a DNG without its finest noise, and one that is refused."""


@dataclass(frozen=True, slots=True)
class RawMetadata:
    """Facts of a raw file; None for those that it does not state.

    ``pattern`` and ``black_dn`` (row by row) are of the top-left 2x2 sites of the visible part, ``area`` (ActiveArea of
    DNG) is its first row and column and the ends of its rows and columns. ``noise_profile`` (NoiseProfile of DNG) is S
    and O of each plane: variance S·x + O with x = 0 at black and 1 at white. ``colour`` are colour tags of a DNG,
    ``xyz2cam`` the matrix in LibRaw's table, ``gains`` those of red and blue as LibRaw reads them, ``compression`` the
    value of the TIFF tag.
    """

    pattern: str | None = None
    black_dn: tuple[float, ...] | None = None
    white_dn: float | None = None
    iso: float | None = None
    exposure_s: float | None = None
    model: str | None = None
    noise_profile: tuple[float, ...] | None = None
    colour: DngColour | None = None
    xyz2cam: Matrix | None = None
    gains: tuple[float, float] | None = None
    compression: int | None = None
    area: tuple[int, int, int, int] | None = None

    def completed(self, other: RawMetadata) -> RawMetadata:
        """Add the facts of another reader that these lack."""
        stated = {field.name: value for field in fields(self) if (value := getattr(self, field.name)) is not None}
        return replace(other, **stated)

    @property
    def bits(self) -> int | None:
        """Bits that hold the white level."""
        return None if self.white_dn is None else int(self.white_dn).bit_length()


class RawFrame(NamedTuple):
    """Visible part of a Bayer mosaic in DN, without masked borders, and the facts of its file."""

    pixels: NDArray[np.uint16]
    metadata: RawMetadata


def decoder_versions() -> dict[str, str]:
    """Versions that decide how raw files are decoded."""
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
        pixels = raw.raw_image_visible
        if facts.area is not None and facts.pattern is not None:
            # LibRaw moves odd margins to even ones, and then confuses the black levels of the sites
            (top, left, bottom, right), (height, width) = facts.area, raw.raw_image.shape
            if not (0 <= top < bottom <= height and 0 <= left < right <= width):
                problem = f"its ActiveArea {facts.area} is not inside of its {width} x {height} sites"
                raise SourceError("corrupt", problem)
            pixels = raw.raw_image[top:bottom, left:right]
        return RawFrame(pixels.copy(), facts.completed(_decoder_facts(raw)))


def read_metadata(path: Path, key: str, with_libraw: bool = True) -> RawMetadata:
    """Read the facts of a raw file: those of TIFF, EXIF and DNG tags, and what LibRaw knows; ``key`` begins messages.

    Raises ConfigError or MachineError.
    """
    for library in ("tifffile", *(["rawpy"] if with_libraw else [])):
        require(library, f"{key}: {path} is a raw file, which needs {library}", "raw", ", or convert the frames to NPY")
    with machine_errors(path):
        content = path.read_bytes()
    tags = tags_of(content, check=False)
    if not with_libraw:
        return tags
    try:
        with opened_by_libraw(content) as raw:
            return tags.completed(_decoder_facts(raw))
    except SourceError as error:
        raise ConfigError(f"{key}: {path} {error.text}") from error


def tags_of(content: bytes, check: bool = True) -> RawMetadata:
    """Read the facts that tags state, whatever the compression; none if the file is no TIFF.

    With ``check``, SourceError unless a TIFF is complete and its raw image is a mosaic of integers.
    """
    import tifffile

    try:
        with tifffile.TiffFile(io.BytesIO(content)) as file:
            pages = [page for first in file.pages for page in (first, *(getattr(first, "pages", ()) or ()))]
            raw = next((page for page in pages if page.tags.valueof(262) in (CFA, LINEAR)), pages[0])
            if check:
                _check_mosaic(raw, len(content))
            exif = pages[0].tags.valueof(34665)
            tags = {tag.code: _tag_values(tag) for page in (pages[0], raw) for tag in page.tags}
            text = pages[0].tags.valueof(50708) or pages[0].tags.valueof(272) or ""
            return _tag_facts(tags, exif if isinstance(exif, Mapping) else {}, str(text).strip("\0 "))
    except (tifffile.TiffFileError, ValueError, KeyError, IndexError, TypeError, ZeroDivisionError):
        return RawMetadata()


def _check_mosaic(page: Any, size: int) -> None:
    """Raise SourceError unless a page is a complete mosaic of integers."""
    end = max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=False)), default=0)
    if end > size:
        raise SourceError("truncated", f"its pixels end at byte {end}, the file at byte {size}")
    photometric = page.tags.valueof(262)
    refusals = {
        "is a linear DNG, whose pixels are demosaicked": photometric == LINEAR,
        "has floating-point pixels": photometric == CFA and page.tags.valueof(339) == FLOATING_POINT,
        "is monochrome": photometric == 1 and 50706 in page.parent.pages[0].tags,
    }
    for what, is_refused in refusals.items():
        if is_refused:
            raise SourceError("unsupported", f"{what}; expected a mosaic of integers")


def _tag_facts(tags: Mapping[int, tuple[float, ...]], exif: Mapping[str, Any], model: str) -> RawMetadata:
    """Collect facts from the tags of TIFF and DNG by code, and from the tags of EXIF by name."""
    black, white = tags.get(50714, ()), tags.get(50717)
    names = ("ISOSpeedRatings", "PhotographicSensitivity", "ISOSpeed", "RecommendedExposureIndex")
    stated = [exif[name] for name in names if name in exif] + [*tags.get(34855, ()), *tags.get(34867, ())]
    isos = [max(iso) if isinstance(iso, tuple) else iso for iso in stated]
    seconds = exif.get("ExposureTime", tags.get(33434))
    if isinstance(seconds, tuple):
        seconds = seconds[0] / seconds[1] if len(seconds) == 2 else seconds[0]
    is_tile = len(black) == 4 and tags.get(50713, (2, 2)) == (2, 2)
    filters, area = tags.get(33422, ()) if 50706 in tags else (), tags.get(50829, ())
    has_bayer = len(filters) == 4 and tags.get(33421, (2, 2)) == (2, 2) and set(filters) <= {0.0, 1.0, 2.0}
    return RawMetadata(
        # CFAPattern and BlackLevel begin at the corner of ActiveArea
        pattern="".join("RGB"[int(code)] for code in filters) if has_bayer else None,
        area=(int(area[0]), int(area[1]), int(area[2]), int(area[3])) if len(area) == 4 else None,
        black_dn=(black * 4)[:4] if black and len(set(black)) == 1 else black if is_tile else None,
        white_dn=max(white) if 50706 in tags and white else None,
        # the largest of 16 bits means that another tag has the ISO
        iso=next((float(iso) for iso in isos if 0 < iso != 65535), None),
        exposure_s=float(seconds) if seconds else None,
        model=model or None,
        noise_profile=tags.get(51041),
        colour=_dng_colour(tags) if 50721 in tags else None,
        compression=int(tags[259][0]) if tags.get(259) else None,
    )


def _dng_colour(tags: Mapping[int, tuple[float, ...]]) -> DngColour:
    """Collect the colour tags of a DNG; ValueError if one has another number of values."""
    codes = [code for code in (50721, 50722) if code in tags]
    lights = (tags.get(code, (0.0,))[0] for code in (50778, 50779))
    red, green, blue = tags.get(50727, (1.0, 1.0, 1.0))
    neutral, white = tags.get(50728), tags.get(50729)
    return DngColour(
        tuple(matrix(tags[code]) for code in codes),
        tuple(LIGHT_K.get(int(light), 0.0) for light in lights)[: len(codes)],
        (matrix(tags.get(50723, IDENTITY)), matrix(tags.get(50724, IDENTITY))),
        (red, green, blue),
        None if neutral is None else (neutral[0], neutral[1], neutral[2]),
        None if white is None else (white[0], white[1]),
        52531 in tags,
    )


def _tag_values(tag: Any) -> tuple[float, ...]:
    """Values of a tag as numbers, rationals divided; none for text."""
    values = tuple(tag.value) if isinstance(tag.value, tuple | bytes) else (tag.value,)
    if not all(isinstance(value, int | float) for value in values):
        return ()
    if tag.dtype in RATIONALS:
        return tuple(top / bottom if bottom else 0.0 for top, bottom in zip(values[::2], values[1::2], strict=True))
    return tuple(map(float, values))


@contextmanager
def opened_by_libraw(content: bytes) -> Iterator[Any]:
    """Open the bytes of a raw file with LibRaw; SourceError unless they are one, and contain a Bayer mosaic."""
    import rawpy

    try:
        with rawpy.imread(io.BytesIO(content)) as raw:
            if raw.raw_type != rawpy.RawType.Flat or raw.raw_pattern is None:
                raise SourceError("unsupported", "contains no mosaic (LibRaw); expected red, green and blue sites")
            if raw.raw_pattern.shape != (2, 2) or raw.num_colors != 3:
                kind = "an X-Trans mosaic" if len(raw.raw_pattern) == 6 else f"a mosaic of {raw.num_colors} colours"
                raise SourceError("unsupported", f"has {kind}; expected a Bayer mosaic")
            yield raw
    except rawpy.LibRawError as error:
        message = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        raise SourceError("corrupt", f"cannot be decoded by LibRaw ({message})") from error


def _decoder_facts(raw: Any) -> RawMetadata:
    """Facts that LibRaw knows of a mosaic; the pattern and the black levels of a Bayer tile."""
    colours, names = raw.raw_colors_visible[:2, :2].ravel().tolist(), raw.color_desc.decode("ascii")
    red, green, blue = (float(gain) for gain in raw.camera_whitebalance[:3])
    entries = [float(f"{entry:.7g}") for entry in raw.rgb_xyz_matrix[:3].ravel()]  # LibRaw has float32
    return RawMetadata(
        pattern="".join(names[colour] for colour in colours),
        black_dn=tuple(float(raw.black_level_per_channel[colour]) for colour in colours),
        white_dn=float(raw.white_level),
        iso=float(raw.other.iso_speed) or None,
        exposure_s=float(raw.other.shutter_speed) or None,
        xyz2cam=matrix(entries) if any(entries) else None,
        gains=(red / green, blue / green) if min(red, green, blue) > 0 else None,
    )
