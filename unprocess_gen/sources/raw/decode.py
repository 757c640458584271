"""Decode raw files of cameras: the mosaic, and what the file states about it.

LibRaw (rawpy) decodes the pixels. Facts come from the tags of files with the structure of TIFF, which take precedence
because LibRaw rounds black levels, and from LibRaw. A fact that neither gives is None. All raw files of sources, dark
frames, captures and cameras are read here, so that all are checked for damage.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import SourceError, refused_files
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.libraries import require
from unprocess_gen.simulation.reference.colour import matrix
from unprocess_gen.sources.image.codec_messages import captured
from unprocess_gen.sources.image.headers import probe
from unprocess_gen.sources.raw.levels import with_one_black
from unprocess_gen.sources.raw.tags import TO_ARRAY, RawMetadata, tags_of

ABOVE_WHITE, MOST_ABOVE = 0.01, 0.001
"""Distance above white, relative to the range, at which sites are damaged if a larger part of them is there."""
ZERO_RUN = 32
"""Zeros in a row that are damage where black is above 0; noise does not clip that many."""
FAR_BELOW_WHITE = 0.25
"""Part of the range below which the brightest site raises doubts about the white level."""
OTHERS = {
    b"\xff\xd8\xff": "JPEG",
    b"ftyp": "HEIF",
    b"JXL ": "JPEG XL",
    b"version ": "Git LFS pointer",
}
"""Files with a wrong suffix, by words in their first bytes; other pictures have headers that are read."""


class RawFrame(NamedTuple):
    """Visible part of a Bayer mosaic in DN, without masked borders, and the facts of its file."""

    pixels: NDArray[np.uint16]
    metadata: RawMetadata


def decoder_versions(kind: str) -> dict[str, str]:
    """Versions that decide how the files of a kind of source are decoded."""
    if kind == "linear":
        return {name.lower(): version(name) for name in ("OpenEXR", "tifffile") if find_spec(name)}
    if kind != "raw":
        return {}
    import rawpy

    return {"rawpy": version("rawpy"), "libraw": ".".join(map(str, rawpy.libraw_version))}


def decode_raw(content: bytes, suffix: str, max_pixels: int = 2**40, white_dn: float | None = None) -> RawFrame:
    """Decode the bytes of a raw file, whose sites may reach ``white_dn`` if that is above its white level.

    Raises SourceError if they are damaged or no mosaic, and ConfigError if a library is missing.
    """
    for library in ("tifffile", "rawpy"):
        require(library, f"raw files need {library}", "raw", ", or convert the frames to NPY")
    facts = tags_of(content)
    with opened_by_libraw(content, suffix) as raw:
        if raw.sizes.width * raw.sizes.height > max_pixels:
            size = f"{raw.sizes.width} x {raw.sizes.height}"
            raise SourceError("too_large", f"has {size} pixels; expected source.max_pixels={max_pixels}")
        if facts.size != raw.raw_image.shape and (facts.size or suffix.lower() == ".dng"):
            problem = "has another mosaic than LibRaw decodes" if facts.size else "has no DNGVersion that can be read"
            raise SourceError("unsupported", f"{problem}; {TO_ARRAY}")
        pixels = raw.raw_image_visible
        if facts.area is not None:
            # LibRaw moves odd margins to even ones, and then confuses the black levels of the sites
            top, left, bottom, right = facts.area
            pixels = raw.raw_image[top:bottom, left:right]
        all_facts = facts.completed(_decoder_facts(raw))
        notes = *facts.notes, *_white_notes(pixels, all_facts, facts.white_dn, white_dn)
        if facts.black_by_site is not None:
            pixels = with_one_black(pixels, facts.black_by_site, all_facts.white_dn or 0.0)
        return RawFrame(pixels.copy(), replace(all_facts, notes=notes))


def _white_notes(
    pixels: NDArray[np.uint16], facts: RawMetadata, tag_dn: float | None, given_dn: float | None
) -> Iterator[str]:
    """Yield doubts about a white level; SourceError if the file is damaged by it.

    LibRaw's levels are not exact. A row records the level, which is given again when its pair is regenerated.
    """
    white = max(given_dn or 0.0, facts.white_dn or 0.0)
    black, brightest = min(facts.black_dn or (0.0,)), int(pixels.max())
    share = np.count_nonzero(pixels > white + ABOVE_WHITE * (white - black)) / pixels.size
    is_known = tag_dn is not None or white > (facts.white_dn or 0.0)
    if is_known and (share > MOST_ABOVE or brightest >> max(int(white).bit_length(), facts.sample_bits)):
        problem = f"has sites of up to {brightest} DN, {share:.2%} of them far above the white level {white:g}"
        raise SourceError("corrupt", f"{problem}; restore it, or state the white level of an intact file")
    run = min(ZERO_RUN, pixels.shape[1])
    is_full = pixels[:, ::run].all() or pixels[:, : pixels.shape[1] // run * run].reshape(-1, run).any(axis=1).all()
    if black >= 1 and not is_full:
        raise SourceError("corrupt", f"has {run} zeros in a row, far below its black level; restore it")
    if share > MOST_ABOVE:
        yield f"has {share:.2%} of its sites above the white level of LibRaw, {white:g} DN"
    if given_dn is None and brightest - black < FAR_BELOW_WHITE * (white - black):
        yield f"has sites of at most {brightest} DN, far below the white level {white:g}"


def read_metadata(path: Path, key: str, with_libraw: bool = True) -> RawMetadata:
    """Read the facts of a raw file; without LibRaw those of its tags, unchecked. ``key`` begins messages.

    Raises ConfigError or MachineError.
    """
    for library in ("tifffile", *(["rawpy"] if with_libraw else [])):
        require(library, f"{key}: {path} is a raw file, which needs {library}", "raw", ", or convert the frames to NPY")
    with machine_errors(path), refused_files(f"{key}: {path}"):
        content = path.read_bytes()
        if not with_libraw:
            return tags_of(content, check=False)
        return decode_raw(content, path.suffix, white_dn=65535.0).metadata  # captures.csv may state another white level


@contextmanager
def opened_by_libraw(content: bytes, suffix: str) -> Iterator[Any]:
    """Open the bytes of a raw file with LibRaw; SourceError unless they are one, and contain a Bayer mosaic."""
    import rawpy

    try:
        with captured() as messages:
            opened = rawpy.imread(io.BytesIO(content))
            opened.unpack()
        with opened as raw:
            if messages:
                text = messages.decode(errors="replace").removeprefix("unknown file: ").splitlines()[0]
                raise SourceError("corrupt", f"is damaged (LibRaw reports: {text})")
            if raw.raw_type != rawpy.RawType.Flat or raw.raw_pattern is None:
                raise SourceError("unsupported", f"has no mosaic, or LibRaw decodes another image of it; {TO_ARRAY}")
            if raw.raw_pattern.shape != (2, 2) or raw.num_colors != 3:
                kind = "an X-Trans mosaic" if len(raw.raw_pattern) == 6 else f"a mosaic of {raw.num_colors} colours"
                raise SourceError("unsupported", f"has {kind}; expected a Bayer mosaic")
            yield raw
    except rawpy.LibRawError as error:
        raise _refusal(content, suffix, error) from error


def _refusal(content: bytes, suffix: str, error: Exception) -> SourceError:
    """The reason why LibRaw does not open a file."""
    import rawpy

    if not content:
        return SourceError("empty", "has 0 bytes")
    text = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
    problem, is_cr3 = f"cannot be decoded by LibRaw ({text})", content[4:11] == b"ftypcrx"
    kind = next((kind for word, kind in OTHERS.items() if word in content[:8] and not is_cr3), "")
    if isinstance(error, rawpy.LibRawFileUnsupportedError):
        if tags_of(content, check=False).size:
            return SourceError("unsupported", f"{problem}; {TO_ARRAY}")
        with suppress(SourceError):
            kind = kind or probe(content).format.upper()
        if not kind and suffix.lower() == ".raw" and not content.startswith((b"II", b"MM")):
            return SourceError("unsupported", f"has no header that states its size and levels; {TO_ARRAY}")
    if kind:
        return SourceError("unsupported", f"contains no raw data: {kind}; expected a raw file")
    return SourceError("corrupt", problem)


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
