"""Results of a simulation: a pair of frames, counts of its sites, and the part of an image that it shows."""

from __future__ import annotations

from dataclasses import dataclass

from unprocess_gen.core.arrays import Frame


@dataclass(frozen=True, slots=True)
class Patch:
    """Rectangle of a full frame: number in the image, row and column of its first pixel, size in pixels.

    An uncut image is patch 0 at row 0, column 0.
    """

    number: int
    y: int
    x: int
    height: int
    width: int

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of the first pixel in the full frame."""
        return self.y, self.x


@dataclass(frozen=True, slots=True)
class Counts:
    """Numbers of sites at a limit.

    Attributes
    ----------
    clean_clipped_low, clean_clipped_high : int
        Clean values below black and above white, before clipping.
    noisy_clipped_low, noisy_clipped_high : int
        Noisy values outside the sensor's range, after rounding (without rounding for float32 frames).
    saturated : int
        Sites of the clean frame at the white level.
    zero_variance : int
        Sites whose noise variance is 0, because a fitted b is negative or no noise is simulated.
    light_clipped_high : int or None
        Sites whose light is above white before the exposure ratio divides it; None without a ratio.
    """

    clean_clipped_low: int
    clean_clipped_high: int
    noisy_clipped_low: int
    noisy_clipped_high: int
    saturated: int
    zero_variance: int
    light_clipped_high: int | None = None


@dataclass(frozen=True, slots=True)
class Pair:
    """Clean and noisy frame of one image, and counts of clipped sites.

    Frames are uint16 mosaics [H, W] in DN, unless the plan has another dtype or layout.
    """

    clean: Frame
    noisy: Frame
    counts: Counts
