"""A source as listed: a photograph, a frame of a clip, or a synthetic picture."""

from __future__ import annotations

from dataclasses import dataclass

NO_CLIP = ""
"""Clip name of a photograph that does not belong to a clip."""


@dataclass(frozen=True, slots=True)
class Source:
    """Photograph, frame of a clip, or synthetic picture, as listed.

    ``index`` is its place in the listing. ``name`` is the path below ``source.root`` as in the manifest
    (`sources.names`), ``path`` as the operating system spells it, with undecodable bytes as surrogate escapes.
    ``size_bytes`` is 0 for a synthetic picture, None if there is no readable file; ``reason`` is then why, one of
    `errors.REASONS`.

    ``occurrence`` is the number of identical files before this one; ``sha256`` is known if the listing hashed the file,
    which it does for files that share a size. ``etag`` identifies the content of an object in a store.

    ``clip`` is the name of the clip (its folder), ``frame`` the number of the frame in it, ``frames`` their number;
    ``clip_sha256`` is the digest of the clip's first frame, ``clip_occurrence`` the number of clips before with the
    same.
    """

    index: int
    name: str
    path: str
    size_bytes: int | None
    reason: str | None = None
    occurrence: int = 0
    sha256: str | None = None
    clip: str = NO_CLIP
    frame: int = 0
    clip_sha256: str | None = None
    clip_occurrence: int = 0
    frames: int = 1
    etag: str | None = None

    def stream_identity(self, sha256: str) -> tuple[str, int]:
        """Digest and occurrence that key the random streams: of the clip if there is one, else of the file."""
        if self.clip_sha256 is not None:
            return self.clip_sha256, self.clip_occurrence
        return sha256, self.occurrence
