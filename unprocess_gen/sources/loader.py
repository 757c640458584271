"""List and load the source images of a run: photographs of a folder, frames of videos, or built-in scenes."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from unprocess_gen.config.interpretation import patch_rule
from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import ConfigError, FilteredError, MachineError, SourceError
from unprocess_gen.core.libraries import require
from unprocess_gen.core.roots import Root, is_remote
from unprocess_gen.core.types import MOSAIC, NO_CLIP, PACKED, Photograph, Source, Srgb
from unprocess_gen.sources import reading
from unprocess_gen.sources.clips import clip_warnings, number_clips
from unprocess_gen.sources.image import decode
from unprocess_gen.sources.listing import Listing, list_file, list_folder, matcher, place_setting
from unprocess_gen.sources.raw.frames import read_raw_source
from unprocess_gen.sources.read_ahead import ReadFile
from unprocess_gen.sources.scenes import synthetic
from unprocess_gen.sources.twins import number_twins
from unprocess_gen.sources.video.decode import Video

OPEN_VIDEOS = 2
"""Videos that a process keeps open: the video of the current shard, and the next one."""


def list_photographs(config: SourceConfig) -> Listing:
    """List every source of the run in order, with identical files and frames of clips numbered; decode no pixel.

    With ``clips``, a file that ``video`` matches becomes one source for each frame, or one failed source if it has no
    readable frame.

    Raises
    ------
    ConfigError
        If the folder does not exist, cannot be read or contains no matching file; if a video matches and PyAV is not
        installed.
    MachineError
        If a file changes while it is hashed.
    """
    place = config.place
    if place is None:
        names = (synthetic.clip_listing if config.clips else synthetic.listing)(config.limit)
        scenes = tuple(Source(index, name, name, size_bytes=0) for index, name in enumerate(names))
        return Listing(number_clips(None, scenes) if config.clips else scenes)
    if config.kind == "raw":
        config = replace(config, video=())
    include = [*(config.include or ()), *(config.video if config.clips else ())]
    if config.list is None:
        listed = list_folder(place, include, config.recursive, config.limit, () if config.clips else config.video)
    else:
        listed = list_file(place, config.list, config.limit)
    numbered = number_twins(place, listed.sources)
    if not config.clips:
        return replace(listed, sources=numbered)
    _refuse_remote_videos(config, place, numbered)
    framed = itertools.islice(_framed(config, numbered), config.limit)
    numbered = number_clips(place, [replace(source, index=index) for index, source in enumerate(framed)])
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
            pixels = synthetic.scene(source.path)
        except ValueError as error:  # only the row of an edited manifest can name a scene that does not exist
            raise SourceError("unreadable", str(error)) from error
        return hashlib.sha256(pixels.data).hexdigest(), Photograph(pixels, orientation=1)
    if source.is_video:
        return _frame(config, place, source)
    content = read(place, source)
    digest = hashlib.sha256(content).hexdigest()
    _check_digest(source, digest)
    try:
        if config.kind == "raw":
            return digest, read_raw_source(config, content, source.name)
        return digest, decode.decode(content, max_pixels=config.max_pixels, icc=config.icc, name=source.name)
    except SourceError as error:
        raise SourceError(error.reason, error.text, digest) from error


def _check_digest(source: Source, digest: str) -> None:
    if source.sha256 not in (None, digest):
        raise MachineError(
            f"source {source.name} has other bytes than when it was listed; expected unchanged sources; "
            "restore it, or choose another out"
        )


# ------------------------------------------------------------------------------------------------------------ videos


def _refuse_remote_videos(config: SourceConfig, root: Root, sources: Iterable[Source]) -> None:
    """Refuse videos in an object store: each worker would download every video once."""
    is_video = matcher(config.video)
    video = next((source for source in sources if is_video(source.path)), None)
    if video is not None and is_remote(root):
        raise ConfigError(
            f"{place_setting(root)}: {video.name} is a video in an object store; expected folders of frames; copy "
            "the videos to a local folder, or omit them with source.video=[]"
        )


def _framed(config: SourceConfig, sources: Iterable[Source]) -> Iterator[Source]:
    """Yield the sources; each video is replaced by one source for each of its frames."""
    is_video = matcher(config.video)
    for source in sources:
        if source.reason is not None or not is_video(source.path) or source.name == NO_CLIP:
            yield source
            continue
        digest, frames = _frames(config, replace(source, clip=source.name))
        for frame in range(frames):
            yield replace(source, clip=source.name, frame=frame, sha256=digest)


def _frames(config: SourceConfig, source: Source) -> tuple[str | None, int]:
    """Return a video's digest and its number of sources: its frames, or one that fails if it cannot be read."""
    assert config.place is not None
    try:
        digest, video = _video(config.place, source)
        video.refuse(config.max_pixels, config.icc)
    except SourceError as error:
        return error.sha256, 1
    return digest, len(video)


def _frame(config: SourceConfig, root: Root, source: Source) -> tuple[str, Photograph]:
    digest, video = _video(root, source)
    _check_digest(source, digest)
    try:
        stored, orientation = video.frame(source.frame, config.max_pixels, config.icc)
    except SourceError as error:
        raise SourceError(error.reason, error.text, digest) from error
    return digest, Photograph(decode.upright(stored, orientation), orientation)


def _video(root: Root, source: Source) -> tuple[str, Video]:
    """Return a video's digest and the open video; both are cached until the file changes."""
    needs = f"source.video: {source.name} is a video, which needs PyAV"
    require("av", needs, "video", ", or omit videos with source.video=[]")
    whole = replace(source, index=0, occurrence=0, sha256=None, frame=0, frames=1, clip_sha256=None, clip_occurrence=0)
    return _open_video(root, whole, reading.stamp(root, source))


@lru_cache(maxsize=OPEN_VIDEOS)
def _open_video(root: Root, source: Source, stamp: reading.Stamp) -> tuple[str, Video]:
    if source.size_bytes == 0:
        raise SourceError("empty", f"{source.name} has 0 bytes")
    file = reading.keep_open(root, source)
    digest = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
    try:
        return digest, Video(file)
    except SourceError as error:
        raise SourceError(error.reason, error.text, digest) from error
