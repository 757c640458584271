"""The frozen records that travel between rooms; what each field means is said once, here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Srgb = NDArray[np.uint8] | NDArray[np.uint16]
Raw = NDArray[np.uint16]
Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Source:
    """One photograph, as the listing found it.

    ``name`` is the manifest's spelling (``/``-joined, percent-encoded where needed); ``path`` the file's path relative
    to the source folder as the operating system spells it (undecodable bytes as surrogate escapes), or the name of a
    synthetic scene. ``size_bytes`` is None where there is no file to read (``reason`` then says why), and 0
    for a scene. Files that share a size were hashed beforehand (``sha256``) and identical ones numbered
    (``occurrence``).
    """

    index: int
    name: str
    path: str
    size_bytes: int | None
    reason: str | None = None
    occurrence: int = 0
    sha256: str | None = None


@dataclass(frozen=True, slots=True)
class Photograph:
    """Decoded pixels: ``srgb`` uint8 or uint16 ``[H, W, 3]`` in R, G, B order, upright (``orientation`` applied)."""

    srgb: Srgb
    orientation: int


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that decides a pair besides its pixels: what a manifest row holds, as numbers.

    Drawn once (`plan.plan_image`) or read back from a row (`manifest.plan_of`). ``weights`` are those of the mixed
    cameras in the order of `colour.CAMERAS`; ``rgb2cam`` is row-major and its rows sum to 1; ``red_gain`` and
    ``blue_gain`` are forward gains, ``inverse_rgb_gain`` an inverse one; ``a_dn`` (DN) and ``b_dn2`` (DN²) are slope
    and intercept of the noise variance above black; ``stream_key`` is the key of the image's random streams.
    """

    seed: int
    stream_key: int
    camera: str
    weights: tuple[float, float, float, float]
    rgb2cam: tuple[float, float, float, float, float, float, float, float, float]
    red_gain: float
    blue_gain: float
    inverse_rgb_gain: float
    tone: str
    gamma: float | str
    highlight: str
    highlight_threshold: float
    pattern: str
    bits: int
    black_level_dn: int
    white_level_dn: int
    sensor_clip: str
    noise: str
    a_dn: float
    b_dn2: float
    effects: tuple[str, ...]
    skipped: tuple[str, ...]
    accuracy: str
    methods: tuple[str, ...]

    @property
    def inverse_gains(self) -> tuple[float, float, float]:
        """What the red, green and blue channel are multiplied by (Brooks et al. 2019, random_gains())."""
        return (
            self.inverse_rgb_gain / self.red_gain,
            self.inverse_rgb_gain,
            self.inverse_rgb_gain / self.blue_gain,
        )


@dataclass(frozen=True, slots=True)
class Counts:
    """How many sites met a limit.

    ``clean_clipped_*``: the value before clipping lay below black or above white; ``noisy_clipped_*``: the rounded
    value lay outside what the sensor can say; ``saturated``: sites of the clean frame at the white level;
    ``zero_variance``: sites where the noise law gives no variance (a fitted b below zero, or no noise at all).
    """

    clean_clipped_low: int
    clean_clipped_high: int
    noisy_clipped_low: int
    noisy_clipped_high: int
    saturated: int
    zero_variance: int


@dataclass(frozen=True, slots=True)
class Pair:
    """The clean and the noisy frame of one photograph, uint16 mosaics ``[H, W]`` in DN, and what was clipped."""

    clean: Raw
    noisy: Raw
    counts: Counts


@dataclass(frozen=True, slots=True)
class Law:
    """How a parameter is drawn: a kind (`plan.LAWS` says what each does) and its numbers; ``constant`` has one."""

    kind: str
    numbers: tuple[float, ...]
