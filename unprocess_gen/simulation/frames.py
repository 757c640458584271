"""Results of a simulation: a pair of frames, counts of its sites, and the part of an image that it shows."""

from dataclasses import dataclass
from typing import Annotated, Any

from unprocess_gen.core.arrays import Frame
from unprocess_gen.core.fields import FAILED, Condition, Field, Integers
from unprocess_gen.simulation.conditions import BURSTS, LIGHT
from unprocess_gen.simulation.plan import COORDINATE, COUNT, PlanRecord

PATCHES = Condition(
    f"source.patch is null, and {BURSTS.unless}",
    lambda config: config.source.patch is not None or BURSTS.holds(config),
)
SIDE = Integers(1, 2**32)
LIMITED_LIGHT = Condition(
    f"scene.exposure_ratio is 1, {LIGHT.unless}; or output.frames is false",
    lambda config: config.output.frames and (config.scene.exposure_ratio != 1 or LIGHT.holds(config)),
)
LINEAR_LIGHT = Condition(
    f"{LIGHT.unless}; or output.frames is false", lambda config: config.output.frames and LIGHT.holds(config)
)


class Patch(PlanRecord, frozen=True):
    """Rectangle of a full frame, which the arrays of a pair show: an uncut image is patch 0 at row 0, column 0."""

    # fmt: off
    width: Annotated[int, Field("width of the frame; packed planes have half of it", SIDE, "pixels")]
    height: Annotated[int, Field("height of the frame; packed planes have half of it", SIDE, "pixels")]
    patch: Annotated[int, Field("number of the patch in its image, from 0", COORDINATE, needs=PATCHES)] = 0
    patch_y: Annotated[int, Field(
        "first row of the arrays in the full frame; even", COORDINATE, "pixels", needs=PATCHES)] = 0
    patch_x: Annotated[int, Field(
        "first column of the arrays in the full frame; even", COORDINATE, "pixels", needs=PATCHES)] = 0
    # fmt: on

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of the first pixel in the full frame."""
        return self.patch_y, self.patch_x


def _sites(meaning: str, **details: Any) -> Field:
    return Field(meaning, COUNT, "sites", **details)


class Counts(PlanRecord, frozen=True):
    """Numbers of sites at a limit; for float32 frames, clipped noisy values are counted without rounding.

    Variance is zero where a fitted b is negative, or if no noise is simulated. ``light_clipped_high`` is None for
    photographs without an exposure ratio, ``light_clipped_low`` for all but linear sources and bursts.
    """

    # fmt: off
    clean_clipped_low: Annotated[int, _sites(
        "clean sites below black before clipping; of raw sources, below the lowest DN")]
    clean_clipped_high: Annotated[int, _sites("clean sites above white before clipping")]
    noisy_clipped_low: Annotated[int, _sites("noisy sites below the lowest DN before clipping")]
    noisy_clipped_high: Annotated[int, _sites("noisy sites above the highest DN before clipping")]
    saturated: Annotated[int, _sites("clean sites at the white level")]
    zero_variance: Annotated[int, _sites("sites at which the noise has no variance")]
    light_clipped_high: Annotated[int | None, _sites(
        "sites whose light is clipped: of photographs, above white before the exposure ratio divides it; of linear "
        "sources and bursts, above 2^16 times white", needs=LIMITED_LIGHT,
        empty_if=f"{FAILED}, or exposure_ratio is 1 and the source neither linear nor a burst")] = None
    light_clipped_low: Annotated[int | None, _sites(
        "sites of a linear source or a burst whose light is negative, and clipped to 0", needs=LINEAR_LIGHT)] = None
    # fmt: on


@dataclass(frozen=True, slots=True)
class Pair:
    """Clean and noisy frame of one image, and counts of clipped sites.

    Frames are uint16 mosaics [H, W] in DN, unless the plan has another dtype or layout.
    """

    clean: Frame
    noisy: Frame
    counts: Counts
