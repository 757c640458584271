"""Decoded pixels of a source."""

from __future__ import annotations

from dataclasses import dataclass

from unprocess_gen.core.arrays import Srgb
from unprocess_gen.simulation.facts import RawParts


@dataclass(frozen=True, slots=True)
class Photograph:
    """Decoded pixels: ``srgb`` (uint8 or uint16 [H, W, 3], R, G, B), after applying the EXIF ``orientation``.

    Of a raw source, ``srgb`` has the codes of its camera RGB, and ``raw`` what the file states. ``note`` is a
    warning about the file.
    """

    srgb: Srgb
    orientation: int
    raw: RawParts | None = None
    note: str = ""
