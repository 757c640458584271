"""List and load the source images of a run: photographs of a folder, or built-in scenes."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from unprocess_gen.config.interpretation import patch_rule
from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import FilteredError, MachineError, SourceError
from unprocess_gen.core.types import MOSAIC, PACKED, Photograph, Source, Srgb
from unprocess_gen.sources import reading, synthetic
from unprocess_gen.sources.clips import clip_warnings, number_clips
from unprocess_gen.sources.image import decode
from unprocess_gen.sources.listing import Listing, list_file, list_folder
from unprocess_gen.sources.raw.frames import read_raw_source
from unprocess_gen.sources.read_ahead import ReadFile
from unprocess_gen.sources.twins import number_twins


def list_photographs(config: SourceConfig) -> Listing:
    """List every source of the run in order, with identical files and frames of clips numbered; decode no pixel.

    Raises
    ------
    ConfigError
        If the folder does not exist, cannot be read or contains no matching file.
    MachineError
        If a file changes while it is hashed.
    """
    place = config.place
    if place is None:
        names = synthetic.list_names(config.limit, config.clips)
        pictures = tuple(Source(index, name, name, size_bytes=0) for index, name in enumerate(names))
        return Listing(number_clips(None, pictures) if config.clips else pictures)
    if config.list is None:
        listed = list_folder(place, config.include or (), config.recursive, config.limit)
    else:
        listed = list_file(place, config.list, config.limit)
    numbered = number_twins(place, listed.sources)
    if not config.clips:
        return replace(listed, sources=numbered)
    numbered = number_clips(place, numbered)
    return replace(listed, sources=numbered, warnings=clip_warnings(numbered))


def load_source(
    config: SourceConfig, source: Source, layout: str = MOSAIC, read: ReadFile = reading.read_bytes
) -> tuple[str, Photograph]:
    """Read, decode and downscale one source; return the SHA-256 of its file, or of a scene's pixels, and the pixels.

    ``read`` reads a photograph; `read_ahead.reading_ahead` provides a function that has read ahead.

    Raises
    ------
    SourceError
        If the source cannot be used or is left out, or no patch or tile fits into it; ``sha256`` is set if the bytes
        could be read.
    MachineError
        If the file is not the one that was listed.
    """
    digest, photograph = _decoded(config, source, read)
    height, width = (side // config.downscale for side in photograph.srgb.shape[:2])
    if config.min_side is not None and min(height, width) < config.min_side:
        text = f"{width} x {height} pixels have a side shorter than source.min_side={config.min_side}"
        raise FilteredError("too_small", text, digest)
    if config.downscale > 1:
        square = f"are less than one square of source.downscale={config.downscale}"
        _check_side(photograph.srgb, config.downscale, square, digest)
        photograph = replace(photograph, srgb=downscaled(photograph.srgb, config.downscale))
    rule = patch_rule(config)
    if rule is not None:
        patch = f"contain no patch of {rule.side} x {rule.side} (source.patch)"
        _check_side(photograph.srgb, rule.side, patch, digest)
    if layout == PACKED:
        _check_side(photograph.srgb, 2, "contain no 2 x 2 tile (output.layout=packed)", digest)
    return digest, photograph


def _check_side(srgb: Srgb, least: int, problem: str, digest: str) -> None:
    height, width = srgb.shape[:2]
    if min(height, width) < least:
        raise SourceError("too_small", f"{width} x {height} pixels {problem}", digest)


def downscaled(srgb: Srgb, side: int) -> Srgb:
    """Average squares of pixels in integer arithmetic; return uint16, the code nearest to each mean.

    8-bit code k counts as 257 k. Rows and columns that fill no square are omitted.
    """
    height, width = (length // side for length in srgb.shape[:2])
    squares = srgb[: height * side, : width * side].reshape(height, side, width, side, 3)
    sums = squares.sum(axis=(1, 3), dtype=np.uint64) * np.uint64(2 * 65535 // int(np.iinfo(srgb.dtype).max))
    count = np.uint64(side * side)
    return np.asarray((sums + count) // (np.uint64(2) * count), dtype=np.uint16)


def _decoded(config: SourceConfig, source: Source, read: ReadFile) -> tuple[str, Photograph]:
    place = config.place
    if place is None:
        try:
            pixels = synthetic.picture(source.path)
        except ValueError as error:  # only the row of an edited manifest can name a scene that does not exist
            raise SourceError("unreadable", str(error)) from error
        return hashlib.sha256(pixels.data).hexdigest(), Photograph(pixels, orientation=1)
    content = read(place, source)
    digest = hashlib.sha256(content).hexdigest()
    if source.sha256 not in (None, digest):
        raise MachineError(
            f"source {source.name} has other bytes than when it was listed; expected unchanged sources; "
            "restore it, or choose another out"
        )
    try:
        if config.kind == "raw":
            return digest, read_raw_source(config, content, source.name)
        return digest, decode.decode(content, max_pixels=config.max_pixels, icc=config.icc, name=source.name)
    except SourceError as error:
        raise SourceError(error.reason, error.text, digest) from error
