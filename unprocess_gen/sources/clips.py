"""Group sources into clips (``source.clips``), and warn about photographs that are no frames of one scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from unprocess_gen.core.types import Source
from unprocess_gen.sources.reading import content_sha256, name_sha256


def number_clips(root: str | None, sources: Sequence[Source]) -> tuple[Source, ...]:
    """Make each folder a clip whose files are frames 0, 1, … in listing order.

    The digest of a clip's first file identifies the clip, so that adding or removing other clips changes nothing. If
    that file cannot be read, or is a built-in scene (no ``root``), the digest of its name is used.
    """
    clips: dict[str, list[Source]] = {}
    for source in sources:
        clips.setdefault(source.name.rpartition("/")[0] or ".", []).append(source)
    seen: Counter[str] = Counter()
    placed: dict[int, Source] = {}
    for clip, frames in clips.items():
        digest = name_sha256(frames[0]) if root is None else content_sha256(root, frames[0])
        for frame, source in enumerate(frames):
            placed[source.index] = replace(
                source, clip=clip, frame=frame, clip_sha256=digest, clip_occurrence=seen[digest], frames=len(frames)
            )
        seen[digest] += 1
    return tuple(placed[source.index] for source in sources)


def clip_warnings(sources: Sequence[Source]) -> tuple[str, ...]:
    """Return a warning if one folder of several photographs is the only clip."""
    clips = {source.clip for source in sources}
    if len(sources) < 2 or len(clips) != 1:
        return ()
    return (
        f"source.clips=true: all {len(sources)} photographs are in one folder and become frames of one clip; "
        "expected one folder for each clip; set source.clips=false if they are different photographs",
    )
