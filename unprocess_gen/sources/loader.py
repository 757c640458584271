"""Load a source: read, decode and downscale a photograph or a raw frame, or draw a synthetic picture."""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import replace

import numpy as np

from unprocess_gen.config.interpretation import burst_rule, patch_rule
from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.arrays import MOSAIC, PACKED, Srgb, last_code
from unprocess_gen.core.errors import FilteredError, MachineError, SourceError
from unprocess_gen.core.source import Source
from unprocess_gen.sources import synthetic
from unprocess_gen.sources.image.decode import Photograph, decode
from unprocess_gen.sources.linear.files import read_linear_source
from unprocess_gen.sources.linear.pixels import linear_photograph
from unprocess_gen.sources.patches import list_patches
from unprocess_gen.sources.raw.frames import read_raw_source
from unprocess_gen.sources.reading import ReadFile, read_bytes


def load_source(
    config: SourceConfig, source: Source, layout: str = MOSAIC, read: ReadFile = read_bytes
) -> tuple[str, Photograph]:
    """Read, decode and downscale one source: the SHA-256 of its file, or of a synthetic picture, and its pixels.

    Raises SourceError if the source cannot be used or is left out, or no patch or tile fits into it, with ``sha256`` if
    the bytes could be read; MachineError if the file is not the one that was listed.
    """
    if config.place is None:
        try:
            if config.kind == "linear":
                photograph = linear_photograph(config, synthetic.scene(source.path))
            else:
                photograph = Photograph(synthetic.picture(source.path), orientation=1)
        except ValueError as error:  # only the row of an edited manifest can name a picture that does not exist
            raise SourceError("unreadable", str(error)) from error
        digest = hashlib.sha256(photograph.srgb.data).hexdigest()
    else:
        content = read(config.place, source)
        digest = hashlib.sha256(content).hexdigest()
        if source.sha256 not in (None, digest):
            raise MachineError(
                f"source {source.name} has other bytes than when it was listed; expected unchanged sources; "
                "restore it, or choose another out"
            )
        try:
            if config.kind == "raw":
                photograph = read_raw_source(config, content, source.name)
            elif config.kind == "linear":
                photograph = read_linear_source(config, content, source.name)
            else:
                photograph = decode(content, max_pixels=config.max_pixels, icc=config.icc, name=source.name)
        except SourceError as error:
            raise SourceError(error.reason, error.text, digest) from error
    _check_size(config, photograph.srgb, layout, digest)
    if config.downscale > 1:
        photograph = replace(photograph, srgb=downscaled(photograph.srgb, config.downscale))
    return digest, photograph


def identity_sha256(config: SourceConfig, source: Source) -> str:
    """Digest that keys the random streams of a source, read from its file unless the listing has it.

    Errors are those of `load_source`; the pixels of a photograph are not decoded.
    """
    known = source.clip_sha256 or source.sha256
    if known is None and config.place is not None:
        return hashlib.sha256(read_bytes(config.place, source)).hexdigest()
    return known or load_source(config, source)[0]


def _check_size(config: SourceConfig, srgb: Srgb, layout: str, digest: str) -> None:
    """Raise FilteredError below ``source.min_side``, SourceError if no square, patch or tile fits."""
    decoded = height, width = srgb.shape[:2]
    prepared = height, width = height // config.downscale, width // config.downscale
    if config.min_side is not None and min(prepared) < config.min_side:
        text = f"{width} x {height} pixels have a side shorter than source.min_side={config.min_side}"
        raise FilteredError("too_small", text, digest)
    rule, burst = patch_rule(config), burst_rule(config)
    side = 1 if rule is None else rule.side
    if burst is not None and not list_patches(rule, 0, *prepared, layout, burst=burst):
        what = "frame" if rule is None else f"patch of {side} x {side}"
        text = f"{width} x {height} pixels contain no {what} with the margin that the motion of source.burst needs"
        raise SourceError("too_small", f"{text}; reduce source.burst.shift or source.patch", digest)
    for (height, width), least, problem in (
        (decoded, config.downscale, f"are less than one square of source.downscale={config.downscale}"),
        (prepared, side, f"contain no patch of {side} x {side} (source.patch)"),
        (prepared, 2 if layout == PACKED else 1, "contain no 2 x 2 tile (output.layout=packed)"),
    ):
        if min(height, width) < least:
            raise SourceError("too_small", f"{width} x {height} pixels {problem}", digest)


def downscaled(srgb: Srgb, side: int) -> Srgb:
    """Average squares of pixels in integer arithmetic: uint16, the code nearest to each mean.

    8-bit code k counts as 257 k. Rows and columns that fill no square are omitted. Light is added in float64, row by
    row, and rounded to float32.
    """
    height, width = (length // side for length in srgb.shape[:2])
    squares = srgb[: height * side, : width * side].reshape(height, side, width, side, 3)
    if srgb.dtype == np.float32:
        total = np.zeros((height, width, 3))
        for y, x in itertools.product(range(side), range(side)):
            total += squares[:, y, :, x]
        return np.asarray(total / (side * side), dtype=np.float32)
    sums = squares.sum(axis=(1, 3), dtype=np.uint64) * np.uint64(2 * 65535 // last_code(srgb))
    count = np.uint64(side * side)
    return np.asarray((sums + count) // (np.uint64(2) * count), dtype=np.uint16)
