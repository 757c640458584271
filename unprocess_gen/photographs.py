"""The photographs of a run, wherever they come from: a folder, or the built-in scenes."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from unprocess_gen import decode, sources, synthetic
from unprocess_gen.config import SourceConfig, patch_law
from unprocess_gen.errors import MachineError, SourceError
from unprocess_gen.manifest import Row, image_key
from unprocess_gen.records import Photograph, Source, Srgb


def list_photographs(config: SourceConfig) -> sources.Listing:
    """Return every photograph of the run in source order, identical files numbered; reads no pixel.

    Raises ConfigError where the folder is missing, cannot be read or holds nothing that ``include`` matches.
    """
    if config.root is None:
        scenes = synthetic.listing(config.limit)
        listed = tuple(Source(index, name, name, size_bytes=0) for index, name in enumerate(scenes))
        return sources.Listing(listed, not_matched=0, skipped_links=0)
    listing = sources.list_folder(config.root, config.include, config.recursive, config.limit)
    numbered = sources.number_twins(config.root, listing.sources)
    if config.clips:
        numbered = sources.number_clips(config.root, numbered)
    return sources.Listing(numbered, listing.not_matched, listing.skipped_links)


def source_of(row: Row) -> Source:
    """Return the source that a row was made from."""
    name, size = str(row["source"]), row["source_bytes"]
    path = sources.decode_name(name)
    return Source(int(image_key(row)), name, path, size if isinstance(size, int) else None)


def load(config: SourceConfig, source: Source) -> tuple[str, Photograph]:
    """Return the SHA-256 of a source's bytes (of a scene's pixels) and its pixels, decoded and downscaled.

    Raises SourceError, with the digest as ``sha256`` where the bytes could be read, also where no patch fits into the
    pixels; MachineError where the file is not the one that was listed.
    """
    digest, photograph = _full_frame(config, source)
    height, width = photograph.srgb.shape[:2]
    law = patch_law(config)
    if law is not None and min(height, width) < law.side:
        text = f"{width} x {height} pixels hold no patch of {law.side} x {law.side} (source.patch)"
        raise SourceError("unsupported", text, digest)
    return digest, photograph


def _full_frame(config: SourceConfig, source: Source) -> tuple[str, Photograph]:
    digest, photograph = _decoded(config, source)
    if config.downscale == 1:
        return digest, photograph
    height, width = photograph.srgb.shape[:2]
    if min(height, width) < config.downscale:
        text = f"{width} x {height} pixels are fewer than source.downscale={config.downscale} takes for one"
        raise SourceError("unsupported", text, digest)
    return digest, replace(photograph, srgb=downscaled(photograph.srgb, config.downscale))


def downscaled(srgb: Srgb, side: int) -> Srgb:
    """Return the mean of each square of pixels as uint16 ``[H // side, W // side, 3]``, the nearest of 65536 codes.

    In whole numbers throughout, so that the extra bits that averaging gives are kept exactly; code k of 255 is k·257.
    Rows and columns that fill no square are left out.
    """
    height, width = (length // side for length in srgb.shape[:2])
    squares = srgb[: height * side, : width * side].reshape(height, side, width, side, 3)
    sums = squares.sum(axis=(1, 3), dtype=np.uint64) * np.uint64(2 * 65535 // int(np.iinfo(srgb.dtype).max))
    count = np.uint64(side * side)
    return np.asarray((sums + count) // (np.uint64(2) * count), dtype=np.uint16)


def _decoded(config: SourceConfig, source: Source) -> tuple[str, Photograph]:
    if config.root is None:
        pixels = synthetic.scene(source.path)
        return hashlib.sha256(pixels.data).hexdigest(), Photograph(pixels, orientation=1)
    content = sources.read_bytes(config.root, source)
    digest = hashlib.sha256(content).hexdigest()
    if source.sha256 not in (None, digest):
        raise MachineError(f"source {source.name} changed while the run was on; start again into another out")
    try:
        return digest, decode.decode(content, max_pixels=config.max_pixels, icc=config.icc)
    except SourceError as error:
        raise SourceError(error.reason, error.text, digest) from error
