"""Read what the tags of a raw file with the structure of TIFF state (DNG, ARW, CR2, NEF, PEF), and check its layout.

LibRaw decodes damaged pixels and some layouts of DNG files wrongly, without a report; they are refused here.
"""

from __future__ import annotations

import io
import itertools
import logging
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import SourceError
from unprocess_gen.simulation.reference.colour import IDENTITY, Matrix, matrix
from unprocess_gen.sources.raw import levels
from unprocess_gen.sources.raw.colour import LIGHT_K, DngColour

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # or it prints messages about damaged files

CFA, LINEAR, MONOCHROME = 32803, 34892, 1
"""Values of PhotometricInterpretation: mosaics (TIFF/EP), demosaicked pixels (DNG), and gray."""
DNG_VERSION, ACTIVE_AREA, CFA_PLANE_COLOR, COLOR_MATRIX_1 = 50706, 50829, 50710, 50721
OF_FILE = (33434, 34855, 34867, COLOR_MATRIX_1, 50722, 50723, 50724, 50727, 50728, 50729, 50778, 50779, 51041, 52531)
"""Tags of the first image that are about the file: exposure, ISO, colours and noise. Levels are of the mosaic's own."""
LAYOUTS = {
    266: "FillOrder", 50711: "CFALayout", 50974: "SubTileBlockSize",
    50975: "RowInterleaveFactor", 52547: "ColumnInterleaveFactor",
}  # fmt: skip
"""Tags that move sites; at other values than 1 LibRaw puts sites at wrong places."""
SIGNED = {2: "signed integers", 3: "floating-point pixels"}
"""Values of SampleFormat that are refused."""
RATIONALS = (5, 10)
"""Types of fractions (TIFF 6.0, section 2)."""
UNCOMPRESSED, LOSSLESS_JPEG, LOSSY_JPEG = 1, 7, 34892
"""Values of Compression of the DNG files that LibRaw decodes; lossy JPEG removes the finest noise."""
CODECS = {5: "LZW", 8: "deflate", 32773: "PackBits", 32946: "deflate", 52546: "JPEG XL"}
TO_ARRAY = "convert it to NPY or TIFF, and give source.raw.pattern, black_dn and white_dn"
UNDECODED = f"which LibRaw does not decode; {TO_ARRAY}"
UNREADABLE = (ValueError, KeyError, IndexError, TypeError, ZeroDivisionError, struct.error)
"""Errors of values that a tag cannot have."""


@dataclass(frozen=True, slots=True)
class RawMetadata:
    """Facts of a raw file; None for those that it does not state.

    ``pattern`` and ``black_dn`` (row by row) are of the top-left 2x2 sites of the visible part, ``area`` (ActiveArea of
    DNG) is its first row and column and the ends of its rows and columns, ``size`` the height and width of all sites of
    a DNG, ``sample_bits`` the bits that hold its values, 0 for 16, of which cameras use fewer. ``black_by_site`` are
    black levels that do not repeat within 2x2 sites; ``black_dn`` is then the lowest. ``white_is_assumed`` is True for
    a DNG without WhiteLevel. ``noise_profile`` (NoiseProfile of DNG) is S and O of each plane: variance S·x + O with
    x = 0 at black and 1 at white. ``colour`` are colour tags of a DNG, ``xyz2cam`` the matrix in LibRaw's table,
    ``gains`` those of red and blue as LibRaw reads them. ``notes`` are sentences about the file without a subject.
    """

    pattern: str | None = None
    black_dn: tuple[float, ...] | None = None
    black_by_site: NDArray[np.float64] | None = None
    white_dn: float | None = None
    white_is_assumed: bool = False
    iso: float | None = None
    exposure_s: float | None = None
    model: str | None = None
    noise_profile: tuple[float, ...] | None = None
    colour: DngColour | None = None
    xyz2cam: Matrix | None = None
    gains: tuple[float, float] | None = None
    size: tuple[int, int] | None = None
    sample_bits: int = 0
    area: tuple[int, int, int, int] | None = None
    notes: tuple[str, ...] = ()

    def completed(self, other: RawMetadata) -> RawMetadata:
        """Add the facts of another reader that these lack; a DNG states pattern and black levels, or has none."""
        own = ("pattern", "black_dn") if self.size else ()
        stated: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(other, **{name: value for name, value in stated.items() if value is not None or name in own})

    @property
    def bits(self) -> int | None:
        """Bits that hold the white level."""
        return None if self.white_dn is None else int(self.white_dn).bit_length()


def tags_of(content: bytes, check: bool = True) -> RawMetadata:
    """Read the facts that tags state, whatever the compression; none if the file is no TIFF.

    Raises SourceError for levels and colours that contradict each other or are not supported, and with ``check`` unless
    the raw image of a TIFF is a complete mosaic of integers.
    """
    import tifffile

    try:
        with tifffile.TiffFile(io.BytesIO(content)) as file:
            pages = [page for first in file.pages for page in (first, *(getattr(first, "pages", ()) or ()))]
            is_dng, raw = DNG_VERSION in pages[0].tags, _mosaic_page(pages)
            if check:
                _check_layout(raw, content, is_dng)
            exif = pages[0].tags.valueof(34665)
            first = {tag.code: _tag_values(tag) for tag in pages[0].tags if tag.code in OF_FILE}
            tags = first | {tag.code: _tag_values(tag) for tag in raw.tags}
            text = str(pages[0].tags.valueof(50708) or pages[0].tags.valueof(272) or "")
            facts = _tag_facts(tags, exif if isinstance(exif, Mapping) else {}, text.strip("\0 "))
            return replace(facts, **_dng_facts(tags, raw.imagelength, raw.imagewidth)) if is_dng else facts
    except (tifffile.TiffFileError, *UNREADABLE):
        return RawMetadata()


def _mosaic_page(pages: Sequence[Any]) -> Any:
    """The image of the mosaic: the largest that is no reduced one; without a mosaic the linear image, or the first."""
    mosaics = [page for page in pages if page.tags.valueof(262) == CFA]
    if mosaics:
        return max(mosaics, key=lambda page: (not page.tags.valueof(254), page.imagelength * page.imagewidth))
    return next((page for page in pages if page.tags.valueof(262) == LINEAR), pages[0])


def _check_layout(page: Any, content: bytes, is_dng: bool) -> None:
    """Raise SourceError unless a page is a complete mosaic of integers, in a layout that LibRaw decodes."""
    from unprocess_gen.sources.raw.lossless_jpeg import line_samples  # imports Numba

    pieces = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    end = max(map(sum, pieces), default=0)
    if end > len(content):
        raise SourceError("truncated", f"its pixels end at byte {end}, the file at byte {len(content)}")
    photometric, is_compressed = page.tags.valueof(262), page.compression == LOSSLESS_JPEG
    if refusal := next(_refusals(page, pieces, photometric, is_dng), ""):
        raise SourceError("unsupported", refusal)
    if not is_dng or photometric != CFA or page.compression == LOSSY_JPEG:
        return
    height, width, places, layout = page.imagelength, page.imagewidth, iter(pieces), ""
    rows, columns = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, width)
    for y, x in itertools.product(range(0, height, rows), range(0, width, columns)):
        (start, size), expected = next(places, (0, 0)), min(rows, height - y) * columns
        sites, problem = 8 * size // page.bitspersample, f"has too few sites for {expected}"
        if is_compressed:
            lines, line, components = line_samples(content[start : start + size]) or (rows, columns, 1)
            sites, problem = lines * line, "has damaged lossless JPEG data"
            is_cut = line % columns != 0 and sites != rows * columns
            if is_cut or (components > 1 and components * line == width):  # LibRaw takes these for two lines
                layout = f"lines of {line} samples with {components} components in tiles of {columns} columns"
                continue
        if sites < expected:
            raise SourceError("corrupt", f"{problem} in the part at row {y}, column {x}")
    if layout:
        raise SourceError("unsupported", f"has {layout}, {UNDECODED}")


def _refusals(page: Any, pieces: Sequence[tuple[int, int]], photometric: int, is_dng: bool) -> Iterator[str]:
    """Yield each fact about the layout of a page that is not supported, and what to do instead."""
    if photometric == LINEAR:
        yield "is a linear DNG, whose pixels are demosaicked; expected a mosaic of integers"
    if photometric == CFA and page.sampleformat in SIGNED:
        yield f"has {SIGNED[page.sampleformat]}; {TO_ARRAY}"
    if not is_dng:
        return
    if photometric == MONOCHROME:
        yield "is monochrome; expected a mosaic of integers"
    problems = [f"{page.bitspersample} bits a site"] if page.bitspersample > 16 else []
    problems += ["tiles wider than the mosaic"] if page.is_tiled and page.tilewidth > page.imagewidth else []
    if page.compression not in (UNCOMPRESSED, LOSSLESS_JPEG, LOSSY_JPEG):
        problems.append(f"the codec {CODECS.get(int(page.compression), int(page.compression))}")
    problems += (name for code, name in LAYOUTS.items() if set(np.ravel(page.tags.valueof(code, 1))) != {1})
    is_apart = any(start + size != after for (start, size), (after, _) in itertools.pairwise(pieces))
    if not page.is_tiled and (is_apart or (len(pieces) > 1 and page.compression == LOSSLESS_JPEG)):
        problems.append("several strips that are compressed, or apart")
    yield from (f"has {problem}, {UNDECODED}" for problem in problems)


def _tag_facts(tags: levels.Tags, exif: Mapping[str, Any], model: str) -> RawMetadata:
    """Collect facts from the tags of TIFF by code, and from the tags of EXIF by name."""
    names = ("ISOSpeedRatings", "PhotographicSensitivity", "ISOSpeed", "RecommendedExposureIndex")
    stated = [exif[name] for name in names if name in exif] + [*tags.get(34855, ()), *tags.get(34867, ())]
    isos = [max(iso) if isinstance(iso, tuple) else iso for iso in stated]
    seconds, black = exif.get("ExposureTime", tags.get(33434)), tags.get(levels.BLACK_LEVEL, ())
    if isinstance(seconds, tuple):
        seconds = seconds[0] / (seconds[1] or float("inf")) if len(seconds) == 2 else seconds[0]  # 0/0 is not known
    return RawMetadata(
        black_dn=(black * 4)[:4] if len(set(black)) == 1 else black if len(black) == 4 else None,
        # the largest of 16 bits means that another tag has the ISO
        iso=next((float(iso) for iso in isos if 0 < iso != 65535), None),
        exposure_s=float(seconds) if seconds else None,
        model=model or None,
    )


def _dng_facts(tags: levels.Tags, height: int, width: int) -> dict[str, Any]:
    """Facts that the tags of a DNG state about mosaic and colours; SourceError if they contradict each other."""
    try:
        filters, order = tags.get(33422, ()), tags.get(CFA_PLANE_COLOR, (0, 1, 2))
        if sorted(order) != [0, 1, 2]:
            raise SourceError("unsupported", f"has CFAPlaneColor {order}; expected red, green and blue in any order")
        planes = [order.index(colour) for colour in range(3)]  # of red, green and blue in the tags about colours
        has_bayer = len(filters) == 4 and tags.get(33421, (2, 2)) == (2, 2) and set(filters) <= {0.0, 1.0, 2.0}
        top, left, bottom, right = area = tuple(map(int, tags.get(ACTIVE_AREA, (0, 0, height, width))))
        if not (0 <= top < bottom <= height and 0 <= left < right <= width):
            raise ValueError(f"ActiveArea {area} is not inside of {width} x {height} sites")
        largest_dn = max(tags.get(levels.LINEARIZATION_TABLE, (2 ** tags[258][0] - 1,)))
        black, white = levels.black_levels(tags, bottom - top, right - left), levels.white_level(tags, largest_dn)
        cell, by_site = None if black is None else tuple(black.ravel().tolist()), None
        if black is not None and black.size > 4:
            cell, by_site = (float(black.min()),) * 4, black
        opcodes, noise = levels.unapplied_opcodes(tags), tags.get(51041)
        white_is_assumed = levels.WHITE_LEVEL not in tags
        notes = {
            "is compressed with lossy JPEG, which removes noise and detail": tags.get(259) == (LOSSY_JPEG,),
            f"states no WhiteLevel; {white:g} DN is assumed": white_is_assumed,
            f"has {opcodes}, which would change the light, and is not applied": opcodes != "",
            "has black levels that differ by site, which are subtracted in integer DN": by_site is not None,
        }
        if noise is not None and len(noise) == 6:
            noise = tuple(number for plane in planes for number in noise[2 * plane : 2 * plane + 2])
        return {
            # CFAPattern and BlackLevel begin at the corner of ActiveArea
            "pattern": "".join("RGB"[int(code)] for code in filters) if has_bayer else None,
            "size": (height, width),
            "sample_bits": int(largest_dn).bit_length() % 16,
            "area": area,
            "black_dn": cell,
            "black_by_site": by_site,
            "white_dn": white,
            "white_is_assumed": white_is_assumed,
            "noise_profile": noise,
            "colour": _dng_colour(tags, planes) if COLOR_MATRIX_1 in tags else None,
            "notes": tuple(note for note, holds in notes.items() if holds),
        }
    except UNREADABLE as error:
        raise SourceError("corrupt", f"its tags contradict each other ({error})") from error


def _dng_colour(tags: levels.Tags, planes: Sequence[int]) -> DngColour:
    """Colour tags of a DNG in the order red, green, blue; ValueError if one has another number of values."""
    codes = [code for code in (COLOR_MATRIX_1, 50722) if code in tags]
    lights = (tags.get(code, (0.0,))[0] for code in (50778, 50779))
    red, green, blue = (tags.get(50727, (1.0, 1.0, 1.0))[plane] for plane in planes)
    neutral, white = tags.get(50728), tags.get(50729)
    return DngColour(
        tuple(_permuted(tags[code], planes, range(3)) for code in codes),
        tuple(LIGHT_K.get(int(light), 0.0) for light in lights)[: len(codes)],
        (_permuted(tags.get(50723, IDENTITY), planes, planes), _permuted(tags.get(50724, IDENTITY), planes, planes)),
        (red, green, blue),
        None if neutral is None else (neutral[planes[0]], neutral[planes[1]], neutral[planes[2]]),
        None if white is None else (white[0], white[1]),
        52531 in tags,
    )


def _permuted(entries: Sequence[float], rows: Iterable[int], columns: Sequence[int]) -> Matrix:
    """Matrix with other orders of rows and columns; ValueError for another number of entries."""
    entries = matrix(entries)
    return matrix([entries[3 * row + column] for row in rows for column in columns])


def _tag_values(tag: Any) -> tuple[float, ...]:
    """Values of a tag as numbers, rationals divided; none for text."""
    values = np.ravel(list(tag.value) if isinstance(tag.value, bytes) else tag.value).tolist()
    if not all(isinstance(value, int | float) for value in values):
        return ()
    if tag.dtype in RATIONALS:
        return tuple(top / bottom if bottom else 0.0 for top, bottom in zip(values[::2], values[1::2], strict=True))
    return tuple(map(float, values))
