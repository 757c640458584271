"""The records that decide a pair: with the pixels, a `Plan` determines both frames completely.

A plan is what planning draws, what effects and kernels are given, and what a manifest row is flattened from
(`dataset.row`): a column has the name of its field, and the order of the fields. A field declares meaning, unit and
allowed values of its number; keys of the settings, columns, checks and reference pages follow from them. A new
parameter is a new field.
"""

import functools
import math
from typing import Annotated, Any, Self, get_args, get_type_hints

import msgspec
import numpy as np

from unprocess_gen.core.arrays import FLOAT32, MOSAIC, PACKED, UINT16
from unprocess_gen.core.exact_distributions import power_of_two
from unprocess_gen.core.fields import (
    FAILED,
    LARGEST,
    Choice,
    Field,
    Integers,
    Limit,
    NumberOrWord,
    Numbers,
    Text,
    number_or_text,
)
from unprocess_gen.core.random_streams import frame_word
from unprocess_gen.simulation.conditions import (
    BURSTS,
    CLIPS,
    DARK_FRAMES,
    DECODED,
    FLOAT_CLEAN,
    LIGHT,
    LIGHTS,
    LINEAR,
    NOISY_FRAMES,
    PHYSICAL,
    PROFILES,
    RAW,
    SHADING,
    SPLITS,
)
from unprocess_gen.simulation.numbers import DN, SHAPE, SITES, Number, number_in_dn, rate
from unprocess_gen.simulation.profiles import UNCONVERTED, Profile
from unprocess_gen.simulation.tone_curves import gamma_text

TIERS = REFERENCE, EXACT, FAST = "reference", "exact", "fast"
"""Accuracy tiers: the NumPy reference, kernels with the same DN, and kernels in float32 where the noise allows it."""

Levels = tuple[float, ...]
"""A level in DN for each packed plane: R, G of the red rows, G of the blue rows, B."""
_FILE_LEVELS = "{} levels of the raw file: R, G of the red rows, G of the blue rows, B, separated by ;"

CODE_RANGE = 65535.0
"""Largest code of a raw source."""

MOST_LIGHT = 65536.0
"""Limit of the light of linear sources, in units of white, which keeps float32 kernels finite."""


# ---------------------------------------------------------------------------------------- allowed values and conditions

_PRINTED = "[^\x00-\x1f\x7f\ud800-\udfff]*", "text without control characters"
ANY_TEXT = Text(*_PRINTED)
LIST = Text(*_PRINTED, write=";".join, read=lambda text: tuple(text.split(";")))
PROFILE = Text(*_PRINTED, write=lambda profile: profile.name, read=Profile)
HEX_KEY = Text("([0-9a-f]{16})?|none", "16 hexadecimal digits", write="{:016x}".format, read=lambda text: int(text, 16))
HEX_128, HEX_256 = (Text(f"([0-9a-f]{{{n}}})?", f"{n} hexadecimal digits") for n in (32, 64))
_XY = r"-?\d{1,3}(\.\d{1,17})?(e-\d\d)?"
_LEVEL = r"\d{1,5}(\.\d{1,17})?(e-\d\d)?"
LEVELS = Text(
    rf"({_LEVEL}(;{_LEVEL}){{3}})?",
    "four numbers, separated by ;",
    write=lambda levels: ";".join(map(repr, levels)),
    read=lambda text: tuple(map(float, text.split(";"))),
)
GAMMA = NumberOrWord(
    "srgb",
    Numbers(0.1, 10),
    "a number from {numbers}, or {word}",
    write=lambda gamma: number_or_text(gamma_text(gamma)),
    read=lambda value: value if value == "srgb" else float(value),
)
FLAG = Integers(0, 1, write=int, read=bool)
COUNT = Integers(0, 2**63 - 1)
SHARE = Numbers(0, 1)
GAIN = Numbers(1e-4, 1e4)
FINITE = Numbers(-LARGEST, LARGEST)
PRIMARIES = Text(
    rf"srgb|p3|rec2020|xyz|acescg|camera|{_XY}(;{_XY}){{7}}",
    "srgb, p3, rec2020, xyz, acescg, camera, or eight numbers, separated by ;",
)
COORDINATE = Integers(0, 2**32 - 1)
"""Pixel coordinates and frame numbers are 32-bit counters of the random streams."""
BAYER = "RGGB", "BGGR", "GRBG", "GBRG"


# ------------------------------------------------------------------------------------------------------------- records


class PlanRecord(msgspec.Struct, frozen=True):
    """Base of the records of a plan."""

    def replace(self, **values: Any) -> Self:
        """Return a copy with other values in fields of the record, and of the records in it.

        Parameters
        ----------
        **values : Any
            New values by the names of the fields.
        """
        part_of, changes = _parts_of_fields(type(self)), dict[str, Any]()
        inner: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            place = changes if (part := part_of.get(name)) is None else inner.setdefault(part, {})
            place[name] = value
        for part, new in inner.items():
            changes[part] = changes.get(part, getattr(self, part)).replace(**new)
        return msgspec.structs.replace(self, **changes)


@functools.cache
def fields_of(record: type[PlanRecord]) -> dict[str, tuple[Any, Any]]:
    """Type and declaration of each field of a record: a `Field`, a `Condition` of a part, or None."""
    hints = get_type_hints(record, include_extras=True)
    return {
        name: (hints[name].__origin__, hints[name].__metadata__[0])
        if hasattr(hints[name], "__metadata__")
        else (hints[name], None)
        for name in record.__struct_fields__
    }


def part_in(kind: Any) -> type[PlanRecord] | None:
    """Record that a field of a type holds; None for a value."""
    kinds = (part for part in (kind, *get_args(kind)) if isinstance(part, type) and issubclass(part, PlanRecord))
    return next(kinds, None)


def declared_fields(record: type[PlanRecord]) -> dict[str, Field]:
    """Declared fields of a record and of the records in it, by name."""
    fields: dict[str, Field] = {}
    for name, (kind, declared) in fields_of(record).items():
        part = part_in(kind)
        fields |= {name: declared} if isinstance(declared, Field) else declared_fields(part) if part else {}
    return fields


@functools.cache
def _parts_of_fields(record: type[PlanRecord]) -> dict[str, str]:
    """Part of a record that has each field of the records in it."""
    parts = {name: part for name, (kind, _) in fields_of(record).items() if (part := part_in(kind))}
    return {
        field: name
        for name, part in parts.items()
        for field in (*part.__struct_fields__, *_parts_of_fields(part))
        if field not in parts  # ``camera`` is a part, and a field of it
    }


class Place(PlanRecord, frozen=True):
    """Numbers that select the random values of a frame of an image; ``epoch`` numbers those of live pairs."""

    # fmt: off
    frame: Annotated[int, Field("number of the frame in its clip or burst, from 0", COORDINATE, needs=CLIPS)] = 0
    level: Annotated[int, Field("number of the noise level, from 0", Integers(0, 99), needs=NOISY_FRAMES)] = 0
    draw: Annotated[int, Field("number of the draw at this level, from 0", Integers(0, 99), needs=NOISY_FRAMES)] = 0
    epoch: int = 0
    # fmt: on

    @property
    def frame_word(self) -> int:
        """Word of the random counter that holds frame and epoch."""
        return frame_word(self.frame, self.epoch)


class CameraPlan(PlanRecord, frozen=True, kw_only=True):
    """Colours and gains of the camera."""

    # fmt: off
    camera: Annotated[str, Field("convex, or the name of the camera", ANY_TEXT)]
    weights: Annotated[tuple[float, float, float, float], Field(
        "weights of the cameras in the mix", SHARE,
        columns={
            f"w_{camera}": "weight of this camera in the mix; 0 if it is not part of it"
            for camera in ("nexus_6p", "sony_a7r", "olympus_em10", "sony_rx100")
        })]
    rgb2cam: Annotated[tuple[float, float, float, float, float, float, float, float, float], Field(
        "matrix from linear sRGB to the camera, whose rows sum to 1", Numbers(-1e10, 1e10),
        columns={
            f"rgb2cam_{i}{j}": f"matrix from linear sRGB to the camera, row {i}, column {j}"
            for i in range(3) for j in range(3)
        })]
    light: Annotated[str, Field("light from which the white-balance gains follow", ANY_TEXT, needs=LIGHTS)] = ""
    cct_k: Annotated[float, Field(
        "correlated colour temperature of the light", Numbers(1000, 25000), "K", needs=LIGHTS, blank=True)] = 0.0
    red_gain: Annotated[float, Field("forward white-balance gain of red", GAIN)]
    blue_gain: Annotated[float, Field("forward white-balance gain of blue", GAIN)]
    inverse_rgb_gain: Annotated[float, Field("inverse of the brightening gain; the image is multiplied by it", GAIN)]
    # fmt: on

    @property
    def inverse_gains(self) -> tuple[float, float, float]:
        """Factors of the red, green and blue channels (Brooks et al. 2019, random_gains())."""
        return self.inverse_rgb_gain / self.red_gain, self.inverse_rgb_gain, self.inverse_rgb_gain / self.blue_gain


class IspPlan(PlanRecord, frozen=True):
    """Processing that is inverted."""

    # fmt: off
    tone: Annotated[str, Field("tone curve that is inverted", Choice("smoothstep", "none"))]
    gamma: Annotated[float | str, Field(
        "exponent that is inverted, or srgb for the piecewise curve of IEC 61966-2-1", GAMMA)]
    highlight: Annotated[str, Field(
        "how highlights are preserved: per_channel as in the article, gray_mean as in the code of Brooks et al., none",
        Choice("per_channel", "gray_mean", "none"))] = "per_channel"
    highlight_threshold: Annotated[float, Field(
        "linear signal above which highlights are preserved; 1 is white", Numbers(0, 1, open_high=True))] = 0.9
    # fmt: on


def _of_raw(meaning: str, limit: Limit, unit: str = "", stated: bool = False) -> Field:
    """Field of a raw source, of what its file ``stated`` or of how it was read."""
    empty_if = f"{FAILED}, or the file does not state it" if stated else FAILED
    return Field(meaning, limit, unit, needs=RAW, blank=True, empty_if=empty_if)


class SourcePlan(PlanRecord, frozen=True):
    """Preparation of the source's pixels; fields of other kinds of sources have their defaults."""

    # fmt: off
    downscale: Annotated[int, Field(
        "side of the squares whose mean becomes one pixel of 16 bits; 2 removes JPEG artefacts, as Brooks et al. did",
        Integers(1, 64), "pixels")]
    dequantize: Annotated[str, Field(
        "dither moves 8-bit codes by up to half a code at random, so that gray areas have more than 256 raw levels; "
        "0, 255 and highlights keep their codes; dither_all moves highlights too, and code 254 up to white",
        Choice("off", "dither", "dither_all"))]
    shrink: Annotated[int, _of_raw(
        "of raw sources: 2 takes the mean of the sites of each colour in cells of 2 x 2 sites, one pixel of camera "
        "RGB from which a new mosaic is sampled; 1 keeps the mosaic", Integers(1, 2))] = 0
    raw_pattern: Annotated[str, _of_raw("CFA pattern of the raw file", Choice(*BAYER))] = ""
    raw_black_dn: Annotated[Levels, _of_raw(_FILE_LEVELS.format("black"), LEVELS, "DN of the file")] = ()
    raw_white_dn: Annotated[Levels, _of_raw(_FILE_LEVELS.format("white"), LEVELS, "DN of the file")] = ()
    mosaic_xxh3: Annotated[str, _of_raw("XXH3-128 of the mosaic that the raw file was decoded to", HEX_128)] = ""
    source_iso: Annotated[float, _of_raw("ISO of the raw file", Numbers(0, 1e9), stated=True)] = 0.0
    source_exposure_s: Annotated[float, _of_raw(
        "exposure time of the raw file", Numbers(0, 1e7), "seconds", stated=True)] = 0.0
    own_a_dn: Annotated[float, _of_raw(
        "noise of the raw source itself in the clean frame, whose variance is own_a_dn (x - black) + own_b_dn2",
        Numbers(0), "DN", stated=True)] = 0.0
    own_b_dn2: Annotated[float, _of_raw(
        "variance at black of the raw source itself in the clean frame", Numbers(0), "DN²", stated=True)] = 0.0
    profile: Annotated[Profile, Field(
        "colour profile from which the photograph was converted; sRGB if it has none, or one with the colours of sRGB",
        PROFILE, needs=PROFILES, blank=True)] = UNCONVERTED
    primaries: Annotated[str, Field(
        "primaries of a linear source: a name, or x and y of red, green, blue and white as its file states them",
        PRIMARIES, needs=LINEAR)] = ""
    pixels_xxh3: Annotated[str, Field(
        "XXH3-128 of the pixels that the file of a linear source, or a HEIC or AVIF file, was decoded to", HEX_128,
        needs=DECODED, blank=True, empty_if=f"{FAILED}, or has another format")] = ""
    # fmt: on

    @property
    def is_linear(self) -> bool:
        """True for scene-linear pictures."""
        return self.primaries != ""

    @property
    def is_raw(self) -> bool:
        """True for raw sources."""
        return self.shrink > 0

    @property
    def code_levels(self) -> tuple[Levels, Levels]:
        """Codes of a raw source at black and at white, by plane: DN, or after averaging the finest binary steps of it.

        The steps are powers of two of a DN, so that means of 2, 4 and 8 sites of up to 12 bits are exact. Codes begin
        at DN 0, so that light below black is kept.
        """
        if self.shrink == 1:
            return self.raw_black_dn, self.raw_white_dn
        span = min(white - black for black, white in zip(self.raw_black_dn, self.raw_white_dn, strict=True))
        steps = 1.0
        while max(self.raw_white_dn) * steps * 2 <= CODE_RANGE:
            steps *= 2
        black = float(int(max(self.raw_black_dn) * steps))
        return (black,) * 4, (black + span * steps,) * 4


CAMERA_LIGHT = SourcePlan(downscale=1, dequantize="off", primaries="camera")
"""Source of the frames of a burst: neither matrix nor gains are applied to their light."""


class SensorPlan(PlanRecord, frozen=True):
    """Digital output of the sensor.

    Sites at a full well keep the noise behind it with ``saturated_as="white"``, and count as saturated.
    """

    # fmt: off
    pattern: Annotated[str, Field(
        "CFA pattern of the top-left 2x2 sites, row by row; MONO has no filters: sites record the mean of the channels",
        Choice(*BAYER, "MONO"))]
    bits: Annotated[int, Field("bits per sample", Integers(1, 16))]
    black_level_dn: Annotated[int, Field("black level, the value without light", Integers(0, 65534), "DN")]
    white_level_dn: Annotated[int, Field("white level, the value at saturation", Integers(1, 65535), "DN")]
    sensor_clip: Annotated[str, Field(
        "clipping of noisy frames: sensor at 0 and 2^bits - 1, black at the black level instead of 0, none only with "
        "float32", Choice("sensor", "black", "none"))] = "sensor"
    saturated_as: Annotated[str, Field(
        "noisy sites whose clean site is saturated: noisy, or white where the converter ends",
        Choice("noisy", "white"))] = "noisy"
    # fmt: on

    @property
    def span_dn(self) -> int:
        """White level minus black level, DN."""
        return self.white_level_dn - self.black_level_dn

    @property
    def limits_dn(self) -> tuple[float, float]:
        """Lowest and highest DN of noisy frames: 0 and 2**bits - 1, which keep the pedestal; see ``sensor_clip``."""
        if self.sensor_clip == "none":
            return -math.inf, math.inf
        return float(self.black_level_dn if self.sensor_clip == "black" else 0), float(2**self.bits - 1)


class ScenePlan(PlanRecord, frozen=True):
    """Light of the scene."""

    # fmt: off
    scene: Annotated[str, Field("name of the scene", ANY_TEXT)]
    exposure_ratio: Annotated[float, Field(
        "divisor of the light in the photograph: 100 leaves a hundredth; frames are not brightened afterwards",
        Numbers(1e-3, 1e6))]
    ev: Annotated[float, Field(
        "exposure of a linear source or of a frame of a burst, whose light is multiplied by 2^ev", Numbers(-64, 64),
        "stops", needs=LIGHT)] = 0.0
    # fmt: on

    @property
    def exposure(self) -> float:
        """Factor applied to the light of the scene."""
        return power_of_two(self.ev) / self.exposure_ratio


TURN, SHIFT = Numbers(-16, 16), Numbers(-(2**40), 2**40)
"""Factors and offsets of a motion: more than any frame needs, and small enough that positions are finite."""


class Motion(PlanRecord, frozen=True):
    """Map from pixels of a burst's frame to the target, and the resolution of the frame.

    The target is the light of the first frame at the resolution of the picture. At this resolution, pixel (p, q) of a
    frame shows the row motion_yy p + motion_yx q + motion_y and the column motion_xy p + motion_xx q + motion_x of the
    target. Centres of pixels are integers.
    """

    # fmt: off
    motion_yy: Annotated[float, Field(
        "factor of p in motion_yy p + motion_yx q + motion_y: the row of the target that pixel (p, q) of a burst's "
        "frame shows, both at the resolution of the target", TURN)]
    motion_yx: Annotated[float, Field("factor of q in the row of the target, see motion_yy", TURN)]
    motion_y: Annotated[float, Field(
        "row of the target that pixel (0, 0) shows, see motion_yy", SHIFT, "pixels of the target")]
    motion_xy: Annotated[float, Field(
        "factor of p in motion_xy p + motion_xx q + motion_x: the column of the target that pixel (p, q) of a burst's "
        "frame shows, both at the resolution of the target", TURN)]
    motion_xx: Annotated[float, Field("factor of q in the column of the target, see motion_xy", TURN)]
    motion_x: Annotated[float, Field(
        "column of the target that pixel (0, 0) shows, see motion_xy", SHIFT, "pixels of the target")]
    burst_downscale: Annotated[int, Field(
        "side s of the square of pixels of the target whose mean is a pixel of a burst's frame", Integers(1, 64),
        "pixels of the target")] = 1
    burst_phase: Annotated[str, Field(
        "centre of pixel i of a burst's frame in pixels of the target, with s = burst_downscale: s i + (s - 1) / 2 for "
        "centre, s i for corner", Choice("centre", "corner"))] = "centre"
    # fmt: on

    def position(self, y: Any, x: Any) -> tuple[Any, Any]:
        """Compute the position in the target that a pixel shows, or arrays of pixels; sums are from left to right."""
        row = self.motion_yy * y + self.motion_yx * x + self.motion_y
        return row, self.motion_xy * y + self.motion_xx * x + self.motion_x

    @property
    def pixel_offset(self) -> float:
        """Offset of the first pixel of a square from s i: 0, or -(s - 1) / 2 with ``corner``."""
        return 0.0 if self.burst_phase == "centre" else -(self.burst_downscale - 1) / 2


class NoisePlan(PlanRecord, frozen=True):
    """Noise profile, its variance, and the effects that are simulated."""

    # fmt: off
    noise: Annotated[str, Field("name of the noise profile, with * if a number of it is overridden", ANY_TEXT)]
    noise_law: Annotated[str, Field(
        "distribution of two-parameter noise: gaussian is one normal distribution, poisson a Poisson count times a "
        "plus a normal distribution of variance b", Choice("gaussian", "poisson"))]
    a_dn: Annotated[float, Field(
        "slope of the noise variance a_dn u + dark_variance_dn2 + (prnu_std u)², u is max(0, x - black); the last term "
        "only with prnu in effects, and not if the clean frame has the fixed patterns", Numbers(-1e30, 1e30), "DN")]
    b_dn2: Annotated[float, Field(
        "noise variance at black of two-parameter noise, or of read noise; see dark_variance_dn2", FINITE, "DN²")]
    effects: Annotated[tuple[str, ...], Field(
        "simulated effects, in order, separated by ;", LIST, blank=True,
        empty_if=f"{FAILED}, or no effect was simulated")] = ()
    skipped: Annotated[tuple[str, ...], Field(
        "skipped effects, each with its reason, separated by ;", LIST, blank=True,
        empty_if=f"{FAILED}, or no effect was skipped")] = ()
    assumed: Annotated[tuple[str, ...], Field(
        "assumed numbers of the profile that the simulated effects use, separated by ;", LIST, needs=PHYSICAL,
        blank=True, empty_if=f"{FAILED}, or no effect uses one")] = ()
    # fmt: on

    @property
    def variance_line(self) -> tuple[float, float]:
        """Slope (DN) and intercept (DN²) of the noise variance above black, for the simulated effects."""
        if "heteroscedastic" in self.effects:
            return self.a_dn, self.b_dn2
        has_read_noise = "read" in self.effects or "dark_frame" in self.effects
        return self.a_dn if "shot" in self.effects else 0.0, self.b_dn2 if has_read_noise else 0.0


class Physics(PlanRecord, frozen=True, kw_only=True):
    """Numbers of a physical noise profile for one scene and sensor.

    The numbers of effects are in the order in which light meets the effects; a number without its effect has the
    default. ``body_key`` keys the fixed patterns of a camera body (`random_streams.body_key`).
    """

    # fmt: off
    iso: Annotated[float, Field("ISO of a physical noise profile", Numbers(0, 1e7, open_low=True))]
    exposure_s: Annotated[float, Field("exposure time", Numbers(1e-7, 1e5), "seconds")]
    temperature_c: Annotated[float, Field("temperature of the sensor", Numbers(-100, 150), "degrees Celsius")]
    lens_shading: Annotated[tuple[float, float, float], Number(
        "relative illumination 1 + k1 r² + k2 r⁴ + k3 r⁶ as [k1, k2, k3]; r is the distance from the centre of the "
        "full frame, 1 in the corners", Numbers(-10, 10), count=3,
        columns={
            f"lens_shading_{n}": f"coefficient of r^{n} in the relative illumination"
            for n in (2, 4, 6)
        })] = (0.0, 0.0, 0.0)
    prnu_std: Annotated[float, Number(
        "standard deviation of the photo response non-uniformity (PRNU), whose mean is 1", Numbers(0, 1),
        key_limit=Numbers(0, 0.5))] = 0.0
    dn_per_e: Annotated[float, Number(
        "system gain K", Numbers(0, 1e20), "DN per electron", kind=DN, by_iso=True, required=True)] = 1.0
    dark_e: Annotated[float, rate(
        "mean dark current of the exposure", key="dark_e_per_s",
        key_meaning="mean dark current at dark_reference_c")] = 0.0
    hot_pixel_share: Annotated[float, Number("fraction of hot pixels", SHARE)] = 0.0
    hot_pixel_e: Annotated[float, rate(
        "mean excess of a hot pixel in the exposure", key="hot_pixel_e_per_s",
        key_meaning="mean of the exponentially distributed current of hot pixels at dark_reference_c")] = 0.0
    full_well_e: Annotated[float, Number(
        "saturation capacity", Numbers(0, 1e9), "electrons", key_limit=Numbers(1, 1e9))] = 0.0
    gain_by_colour: Annotated[tuple[float, float, float], Number(
        "system gain of red, green and blue, relative to dn_per_e", Numbers(0.1, 10), count=3,
        columns={
            f"gain_{colour[0]}": f"system gain of {colour}, relative to dn_per_e"
            for colour in ("red", "green", "blue")
        })] = (1.0, 1.0, 1.0)
    read_law: Annotated[str, Number(
        "distribution of the read noise: gaussian, or tukey_lambda for Tukey's lambda with a shape from -0.45",
        Choice("gaussian", "tukey_lambda"), key_default="gaussian")] = "gaussian"
    read_shape: Annotated[float, Number(
        "shape of Tukey's lambda distribution", Numbers(-0.5, 10), kind=SHAPE, by_iso=True, key_default=0.0)] = 0.0
    read_std_dn: Annotated[float, number_in_dn("standard deviation of the read noise", required=True, counter=1)] = 0.0
    row_std_dn: Annotated[float, number_in_dn("standard deviation of row offsets", counter=2)] = 0.0
    row_correlation: Annotated[float, Number(
        "correlation of the offsets of neighbouring rows, an autoregressive process of order 1; part of the effect row",
        Numbers(-0.999, 0.999), optional="independent rows")] = 0.0
    column_std_dn: Annotated[float, number_in_dn("standard deviation of column offsets", counter=3)] = 0.0
    column_temporal_std_dn: Annotated[float, number_in_dn(
        "standard deviation of the part of column offsets that is new in every frame", counter=4)] = 0.0
    black_error_dn: Annotated[tuple[float, float, float, float], Number(
        "error of the black level", FINITE, "DN", kind=SITES, by_iso=True, count=4,
        columns={
            f"black_error_dn_{i}{j}": f"black-level error of the 2x2 CFA pattern, row {i}, column {j}"
            for i in range(2) for j in range(2)
        })] = (0.0, 0.0, 0.0, 0.0)
    dsnu_std_e: Annotated[float, Number(
        "standard deviation of the dark-signal non-uniformity (DSNU), whose mean is 0", Numbers(0, 1e9), "electrons",
        key_limit=Numbers(0, 1e6))] = 0.0
    dead_pixel_share: Annotated[float, Number("fraction of dead pixels", SHARE)] = 0.0
    dead_pixel_level: Annotated[float, Number(
        "value of dead pixels as a fraction of the black level; part of the effect dead_pixels", SHARE,
        optional="0 DN")] = 0.0
    dark_offset: Annotated[str, Field(
        "mean of the dark current: removed as a camera does with optical-black pixels, or kept",
        Choice("removed", "kept"))]
    sensor_unit: Annotated[str, Field("camera body", ANY_TEXT)]
    body_key: Annotated[int, Field("key of the fixed patterns, 16 hex digits", HEX_KEY)]
    fixed_pattern_in_clean: Annotated[bool, Field("1 if the clean frame has the fixed patterns too", FLAG)]
    frame_size: Annotated[tuple[int, int], Field(
        "size of the full frame, to which the lens shading belongs", COORDINATE, "pixels", needs=SHADING, blank=True,
        columns={
            f"frame_{side}": f"{side} of the full frame, to which the lens shading belongs"
            for side in ("height", "width")
        })] = (0, 0)
    # fmt: on


class DarkFramePlan(PlanRecord, frozen=True):
    """Dark frame whose noise replaces that of the read-out."""

    # fmt: off
    dark_frame: Annotated[str, Field(
        "SHA-256 of the dark frame from which the noise of the read-out is sampled", HEX_256)]
    shift: Annotated[tuple[int, int], Field(
        "first row and column of the dark frame that the full frame uses; even", COORDINATE, "pixels",
        columns={
            f"dark_frame_{axis}": f"first {side} of the dark frame that the full frame uses; even"
            for axis, side in (("y", "row"), ("x", "column"))
        })]
    dark_black_dn: Annotated[float, Field("black level of the dark frame", Numbers(0, 65535), "DN of the dark frame")]
    dark_scale: Annotated[float, Field("DN of the sensor per DN of the dark frame", Numbers(1e-9, 1e9))]
    # fmt: on


class OutputPlan(PlanRecord, frozen=True):
    """Format of the frames."""

    # fmt: off
    dtype: Annotated[str, Field(
        "type of the arrays: uint16 in DN, or float32 with 0 at black and 1 at white, not rounded",
        Choice(UINT16, FLOAT32))] = UINT16
    layout: Annotated[str, Field(
        "layout of the arrays: mosaic is [H, W], packed is [4, H/2, W/2] with planes R, G of red rows, G of blue "
        "rows, B", Choice(MOSAIC, PACKED))] = MOSAIC
    clean_dtype: Annotated[str, Field(
        "dtype of the clean array, if it is not that of dtype", Choice(FLOAT32), needs=FLOAT_CLEAN, blank=True,
        empty_if=f"{FAILED}, or the clean array has the dtype of the noisy one")] = ""
    # fmt: on

    @property
    def normalised(self) -> bool:
        """True if noisy frames are float32, 0 at black and 1 at white, without rounding to DN."""
        return self.dtype == FLOAT32

    @property
    def clean_normalised(self) -> bool:
        """True if the clean frame is float32, 0 at black and 1 at white, without rounding to DN."""
        return (self.clean_dtype or self.dtype) == FLOAT32


class Plan(PlanRecord, frozen=True, kw_only=True):
    """All parameters of a pair; with the pixels it determines the pair completely.

    A plan is drawn once (`unprocess_gen.plan_image`) or read from a manifest row. ``split`` decides no pixel;
    ``physics`` is None for two-parameter profiles, whose one effect is ``heteroscedastic``.
    """

    # fmt: off
    seed: Annotated[int, Field("seed of all random streams", COUNT, empty_if="")]
    stream_key: Annotated[int, Field("key of the image's random streams, 16 hex digits", HEX_KEY)]
    split: Annotated[str, Field(
        "part of the dataset that the image belongs to", Text(r"[\w-]{1,32}", "up to 32 letters, digits, _ and -"),
        needs=SPLITS)] = ""
    place: Place = Place()
    camera: CameraPlan
    isp: IspPlan
    source: SourcePlan
    motion: Annotated[Motion | None, BURSTS] = None
    sensor: SensorPlan
    scene: ScenePlan
    noise: NoisePlan
    accuracy: Annotated[str, Field(
        "accuracy tier: reference is computed by NumPy and is slow, exact gives the same DN, fast is less exact for "
        "noise with two numbers", Choice(*TIERS))]
    physics: Annotated[Physics | None, PHYSICAL] = None
    dark: Annotated[DarkFramePlan | None, DARK_FRAMES] = None
    output: OutputPlan = OutputPlan()
    # fmt: on

    def __repr__(self) -> str:
        key, camera, noise, scene = self.stream_key, self.camera.camera, self.noise.noise, self.scene.scene
        return f"Plan(stream_key={key:016x}, camera={camera}, noise={noise}, scene={scene}, accuracy={self.accuracy})"

    @property
    def pixel_side(self) -> int:
        """Side of the square of the picture that a pixel of the frames shows: more than 1 for bursts only."""
        return 1 if self.motion is None else self.motion.burst_downscale

    @property
    def of_light(self) -> Self:
        """Plan whose source is light in camera RGB at the resolution of the frame; without motion, this plan."""
        if self.motion is None:
            return self
        return self.replace(motion=None, source=CAMERA_LIGHT, highlight="none")

    def decoded(self, profile: Profile, pixels_xxh3: str = "") -> Self:
        """Return the plan with the colours of its photograph, which no draw depends on, and the digest of pixels."""
        if (profile, pixels_xxh3) == (self.source.profile, self.source.pixels_xxh3):
            return self
        return self.replace(profile=profile, pixels_xxh3=pixels_xxh3)

    @property
    def numbers(self) -> Physics:
        """Numbers of the physical profile, which the plan must have."""
        assert self.physics is not None
        return self.physics

    def __hash__(self) -> int:
        """Hash a few numbers: hashes of all fields take ten times as long, and patches look up their plan's records.

        Plans that are redrawn for an epoch differ in drawn numbers only.
        """
        drawn = self.camera.rgb2cam[0], self.camera.inverse_rgb_gain, self.scene.exposure_ratio
        return hash((self.stream_key, self.place, self.noise.a_dn, drawn))

    @property
    def counts_electrons(self) -> bool:
        """True if the noise contains Poisson counts, not only one normal deviate per site."""
        return self.physics is not None or (self.noise.noise_law == "poisson" and self.noise.variance_line[0] > 0)

    @property
    def averaged(self) -> bool:
        """True if the clean frame contains the fixed patterns, like the average of many frames."""
        return self.physics is not None and self.physics.fixed_pattern_in_clean

    @property
    def clean(self) -> tuple[object, ...]:
        """All that decides the clean frame; pairs with equal ones share it."""
        physics, effects, sensor = self.physics, self.noise.effects, self.sensor
        has_shading = physics is not None and "lens_shading" in effects
        return (
            *(self.stream_key, self.source, self.scene, self.camera, self.isp, self.output),
            *(sensor.pattern, sensor.bits, sensor.black_level_dn, sensor.white_level_dn),
            *(self.clean_accuracy, self.darkest, self.brightest),
            (self.numbers.lens_shading, self.numbers.frame_size) if has_shading else None,
            (physics, effects, sensor.sensor_clip) if self.averaged else None,
        )

    @property
    def clean_accuracy(self) -> str:
        """Accuracy tier of the clean frame: ``exact`` in place of ``fast`` for float32 frames and Poisson counts.

        No drawn number decides it, so that all noise levels of an image have the same clean frame.
        """
        has_counts = self.physics is not None or self.noise.noise_law == "poisson"
        return EXACT if self.accuracy == FAST and (has_counts or self.output.clean_normalised) else self.accuracy

    @property
    def brightest(self) -> float:
        """Light at which the clean frame saturates: 1 (white), or less if the full well is reached below white."""
        physics = self.physics
        if physics is None or "full_well" not in self.noise.effects:
            return 1.0
        return min(1.0, physics.full_well_e * physics.dn_per_e / self.sensor.span_dn)

    @property
    def darkest(self) -> float:
        """Light below which the clean frame is clipped: 0; for raw sources, that of the lowest DN of noisy frames.

        Read noise of a raw source is below black too. Clipped there, its mean would rise and its variance fall.
        """
        if not self.source.is_raw:
            return 0.0
        return (self.sensor.limits_dn[0] - self.sensor.black_level_dn) / self.sensor.span_dn

    @property
    def most_light(self) -> float:
        """Light up to which the noise follows it: `brightest`, where light is clipped; more for linear sources."""
        return MOST_LIGHT if self.source.is_linear else self.brightest

    @property
    def brightest_dn(self) -> float:
        """Value of `brightest` in DN, unrounded."""
        return self.brightest * float(self.sensor.span_dn) + float(self.sensor.black_level_dn)

    @property
    def darkest_dn(self) -> float:
        """Value of `darkest` in DN, unrounded."""
        return self.darkest * float(self.sensor.span_dn) + float(self.sensor.black_level_dn)

    @property
    def pins_saturated(self) -> bool:
        """True if noisy sites have the value of the clean frame where that saturates."""
        return self.sensor.saturated_as == "white" and self.brightest == 1

    @property
    def saturated_value(self) -> float:
        """Value of clean sites that count as saturated: white, or the full well below it with ``"white"``."""
        sensor = self.sensor
        value_dn = self.brightest_dn if sensor.saturated_as == "white" else float(sensor.white_level_dn)
        if not self.output.clean_normalised:
            return float(round(value_dn))
        return float(np.float32((value_dn - sensor.black_level_dn) / sensor.span_dn))


NUMBERS: dict[str, Number] = {
    name: declared for name, (_, declared) in fields_of(Physics).items() if isinstance(declared, Number)
}
"""Numbers of all effects by the names of their fields."""


FIELDS = declared_fields(Plan)
"""All declared fields of a plan by their names; keys of the settings refer to them."""


def numbers_of(name: str) -> Numbers:
    """Numbers that a field of the plan allows."""
    limit = FIELDS[name].limit
    assert isinstance(limit, Numbers)
    return limit
