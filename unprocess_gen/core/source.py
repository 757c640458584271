"""A source as listed: a photograph, a frame of a clip, or a synthetic picture."""

from __future__ import annotations

from dataclasses import dataclass

NO_CLIP = ""
"""Clip name of a photograph that does not belong to a clip."""


@dataclass(frozen=True, slots=True)
class Source:
    """Photograph, or frame of a clip, as listed.

    Attributes
    ----------
    index : int
        Place in the listing, from 0.
    name : str
        Path below ``source.root`` as in the manifest: joined by ``/``, percent-encoded if necessary.
    path : str
        Path below ``source.root`` as the operating system spells it (undecodable bytes as surrogate escapes), or the
        name of a synthetic picture.
    size_bytes : int or None
        Size of the file; 0 for a scene, None if there is no readable file.
    reason : str or None
        Reason why the source cannot be used, one of `errors.REASONS`.
    occurrence : int
        Number of identical files before this one.
    sha256 : str or None
        SHA-256 of the file if the listing hashed it, which it does for files that share a size.
    clip : str
        Name of the clip (its folder), or `NO_CLIP`.
    frame : int
        Number of the frame in its clip, from 0.
    clip_sha256 : str or None
        SHA-256 of the clip's first frame, or None without a clip.
    clip_occurrence : int
        Number of clips before this one with the same ``clip_sha256``.
    frames : int
        Number of frames in the clip; 1 for a photograph.
    etag : str or None
        ETag of the object in an object store, which identifies its content; None for files and scenes.
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
        """Return the digest and occurrence number that key the random streams.

        Parameters
        ----------
        sha256 : str
            SHA-256 of the source's file.

        Returns
        -------
        (str, int)
            Digest and occurrence of the clip if there is one, else of the file.
        """
        if self.clip_sha256 is not None:
            return self.clip_sha256, self.clip_occurrence
        return sha256, self.occurrence
