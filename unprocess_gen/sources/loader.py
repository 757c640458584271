"""The photographs of a run, wherever they come from: a folder, the videos in it, or the built-in scenes."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from unprocess_gen.config.derived import patch_rule
from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.types import MOSAIC, NO_CLIP, PACKED, Photograph, Source, Srgb
from unprocess_gen.sources import listing as sources
from unprocess_gen.sources.image import decode
from unprocess_gen.sources.scenes import synthetic
from unprocess_gen.sources.video.decode import Video, is_installed

FILMS_OPEN = 2
"""Videos that a process keeps open: the one its shard is in, and the next."""


def list_photographs(config: SourceConfig) -> sources.Listing:
    """Return every photograph of the run in source order, identical files numbered; reads no pixel.

    With ``clips``, files that ``video`` matches are clips: a source for every frame, one for a video that has none to
    give. Raises ConfigError where the folder is missing, cannot be read or holds nothing that ``include`` matches, and
    where there is a video and nothing to read it with.
    """
    if config.root is None:
        scenes = synthetic.listing(config.limit)
        listed = tuple(Source(index, name, name, size_bytes=0) for index, name in enumerate(scenes))
        return sources.Listing(listed, not_matched=0, skipped_links=0)
    include = [*config.include, *(config.video if config.clips else ())]
    listing = sources.list_folder(config.root, include, config.recursive, config.limit)
    numbered = sources.number_twins(config.root, listing.sources)
    if config.clips:
        framed = itertools.islice(_framed(config, numbered), config.limit)
        numbered = sources.number_clips(
            config.root, [replace(source, index=index) for index, source in enumerate(framed)]
        )
    return sources.Listing(numbered, listing.not_matched, listing.skipped_links)


def evenly_spaced(sources: tuple[Source, ...], count: int) -> tuple[Source, ...]:
    """Return at most ``count`` sources, evenly spread over the listing."""
    if len(sources) <= count:
        return sources
    return tuple(sources[i * len(sources) // count] for i in range(count))


def load_source(config: SourceConfig, source: Source, layout: str = MOSAIC) -> tuple[str, Photograph]:
    """Return the SHA-256 of a source's bytes (of a scene's pixels) and its pixels, decoded and downscaled.

    Raises SourceError, with the digest as ``sha256`` where the bytes could be read, also where no patch fits into the
    pixels, or no 2x2 tile that packed planes could be made of; MachineError where the file is not the one that was
    listed.
    """
    digest, photograph = _full_frame(config, source)
    height, width = photograph.srgb.shape[:2]
    law = patch_rule(config)
    if law is not None and min(height, width) < law.side:
        text = f"{width} x {height} pixels hold no patch of {law.side} x {law.side} (source.patch)"
        raise SourceError("unsupported", text, digest)
    if layout == PACKED and min(height, width) < 2:
        text = f"{width} x {height} pixels hold no 2 x 2 sites, one for each plane (output.layout=packed)"
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
    if source.is_video:
        return _frame(config, config.root, source)
    content = sources.read_bytes(config.root, source)
    digest = hashlib.sha256(content).hexdigest()
    _check_digest(source, digest)
    try:
        return digest, decode.decode(content, max_pixels=config.max_pixels, icc=config.icc)
    except SourceError as error:
        raise SourceError(error.reason, error.text, digest) from error


def _check_digest(source: Source, digest: str) -> None:
    if source.sha256 not in (None, digest):
        raise MachineError(f"source {source.name} changed while the run was on; start again into another out")


# ------------------------------------------------------------------------------------------------------------ videos


def _framed(config: SourceConfig, found: tuple[Source, ...]) -> Iterator[Source]:
    """Yield the sources, and in place of each video one for each of its frames."""
    is_video = sources.matcher(config.video)
    for source in found:
        if source.reason is not None or not is_video(source.path) or source.name == NO_CLIP:
            yield source
            continue
        digest, frames = _frames(config, replace(source, clip=source.name))
        for frame in range(frames):
            yield replace(source, clip=source.name, frame=frame, sha256=digest)


def _frames(config: SourceConfig, source: Source) -> tuple[str | None, int]:
    """Return a video's digest and how many sources it is: its frames, or one for the row that says why it has none."""
    assert config.root is not None
    try:
        digest, film = _film(config.root, source)
        film.refuse(config.max_pixels, config.icc)
    except SourceError as error:
        return error.sha256, 1
    return digest, len(film)


def _frame(config: SourceConfig, root: str, source: Source) -> tuple[str, Photograph]:
    digest, film = _film(root, source)
    _check_digest(source, digest)
    try:
        stored, orientation = film.frame(source.frame, config.max_pixels, config.icc)
    except SourceError as error:
        raise SourceError(error.reason, error.text, digest) from error
    return digest, Photograph(decode.upright(stored, orientation), orientation)


def _film(root: str, source: Source) -> tuple[str, Video]:
    """Return a video's digest and the video, both of them as long as its file stays untouched."""
    if not is_installed():
        raise ConfigError(
            f"source.video: {source.name} is a video, which needs PyAV: pip install 'unprocess_gen[video]'; "
            "or leave videos out with source.video=[]"
        )
    whole = replace(source, index=0, occurrence=0, sha256=None, frame=0, frames=1, clip_sha256=None, clip_occurrence=0)
    return _opened_film(root, whole, sources.stamp(root, source))


@lru_cache(maxsize=FILMS_OPEN)
def _opened_film(root: str, source: Source, stamp: sources.Stamp) -> tuple[str, Video]:
    if source.size_bytes == 0:
        raise SourceError("empty", f"{source.name} has 0 bytes")
    file = sources.keep_open(root, source, stamp)
    digest = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
    try:
        return digest, Video(file)
    except SourceError as error:
        raise SourceError(error.reason, error.text, digest) from error
